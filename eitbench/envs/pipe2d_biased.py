"""`eitbench/Pipe2DBiasedVelocity-v0`."""

from __future__ import annotations

from typing import Any

from gymnasium.utils import EzPickle

from eitbench import _check
from eitbench.envs.arguments import assumed_flow, with_fields
from eitbench.envs.estimation import EstimationEnv
from eitbench.envs.estimation_vector import EstimationVectorEnv
from eitbench.worlds import Pipe2DBiasedVelocity


class Pipe2DBiasedVelocityEnv(EstimationEnv, EzPickle):
    """
    ## Description

    The pipe of `eitbench/Pipe2D-v0`, but the mean velocity that estimators are told, 4.5 m/s, is not the true one,
    which is drawn for each episode from 2.5 … 7 m/s (Seppänen 2005, 5.1.2, Figs 5.7 and 5.8; all numbers in
    `eitbench.worlds.Pipe2DBiasedVelocity`). How much does a method suffer from a wrong model of the flow?

    In the thesis the truth is 450 cm/s and the assumed velocity varies; that is
    `gym.make(id, true_mean_velocity=4.5, assumed_mean_velocity=2.0)` here.

    ## Action space

    `Box(-250, 250, (1701,), float64)`: the estimate of c_{t − lag} at the nodes of `task.mesh`, mol/m³.

    ## Observation space

    As in `eitbench/Pipe2D-v0`: `voltages` in V and `currents` in A per metre of depth, 16 of each.

    ## Reward

    −∫(ĉ_t − c_t)² dΩ / ∫c_t² dΩ for the 80 scored states t = 19 … 98, else 0.

    ## Starting state

    The fluid has been flowing until the slowest that may be drawn has flushed the pipe. `reset(seed=s)` plays
    episode s.

    ## Episode end

    Terminated after 98 + lag steps. Never truncated.

    ## Arguments

    | name | default | meaning |
    |---|---|---|
    | `true_mean_velocity` | None | m/s; None: drawn for each episode |
    | `assumed_mean_velocity` | None | m/s; what the task's model believes; None: 4.5 |
    | `assumed_profile` | None | "parabolic" (as it is), "plug" or "power-law" (exponent 1/7) |
    | `lag` | 0 | an integer from 0 to 97, or "all" (= 97): whole record first |
    | `scenario` | None | dict of `Pipe2DBiasedVelocity` fields to change |
    | `episodes` | 1000 | number of training episodes for unseeded resets |
    | `render_mode` | None | "rgb_array": truth, estimate, spread and active pair |

    ## Version history

    * v0: first version.
    """

    def __init__(self, *, true_mean_velocity: float | None = None, assumed_mean_velocity: float | None = None,
                 assumed_profile: str | None = None, lag: int | str = 0, scenario: dict[str, Any] | None = None,
                 episodes: int = 1000, render_mode: str | None = None) -> None:
        EzPickle.__init__(self, true_mean_velocity=true_mean_velocity, assumed_mean_velocity=assumed_mean_velocity,
                          assumed_profile=assumed_profile, lag=lag, scenario=scenario, episodes=episodes,
                          render_mode=render_mode)
        super().__init__(_scenario(scenario, true_mean_velocity), lag=lag, episodes=episodes, render_mode=render_mode,
                         assumptions=assumed_flow(assumed_mean_velocity, assumed_profile))


class Pipe2DBiasedVelocityVectorEnv(EstimationVectorEnv):
    """`Pipe2DBiasedVelocityEnv`, many times; arguments as there."""

    def __init__(self, *, num_envs: int = 1, true_mean_velocity: float | None = None,
                 assumed_mean_velocity: float | None = None, assumed_profile: str | None = None, lag: int | str = 0,
                 scenario: dict[str, Any] | None = None, episodes: int = 1000) -> None:
        assumed_flow(assumed_mean_velocity, assumed_profile)       # what estimators believe changes nothing here
        super().__init__(_scenario(scenario, true_mean_velocity), num_envs, lag=lag, episodes=episodes)


def _scenario(changes: dict[str, Any] | None, mean_velocity: float | None) -> Pipe2DBiasedVelocity:
    if mean_velocity is not None:
        fixed = _check.number("true_mean_velocity", mean_velocity, low=0.0, open_low=True, units="m/s")
        changes = {**(changes or {}), "velocity_range": (fixed, fixed)}
    return with_fields(Pipe2DBiasedVelocity, changes)
