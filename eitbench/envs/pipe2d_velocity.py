"""The 2D pipe with a flow that is to be estimated too: three ids, one class."""

from __future__ import annotations

from typing import Any

from gymnasium.utils import EzPickle

from eitbench.envs.arguments import with_fields
from eitbench.envs.estimation import EstimationEnv
from eitbench.envs.estimation_vector import EstimationVectorEnv
from eitbench.worlds import Pipe2DSkewedVelocity, Pipe2DTimeVaryingVelocity, Pipe2DUnknownVelocity

FLOWS = {"unknown": Pipe2DUnknownVelocity, "time-varying": Pipe2DTimeVaryingVelocity, "skewed": Pipe2DSkewedVelocity}


class Pipe2DVelocityEnv(EstimationEnv, EzPickle):
    """
    ## Description

    The pipe of `eitbench/Pipe2D-v0`, but the flow is not known: estimate the concentration and the flow from the
    voltages (Seppänen 2005, ch. 6; all numbers in `eitbench.worlds.pipe2d_flows`). The axial velocity is written as
    v̂(y) = Σ θ_k φ_k(y/R); `task.velocity` holds the φ_k, what is believed of θ at first, and how fast it may change.

    ## Ids

    | id | true flow, drawn for each episode | k |
    |---|---|---|
    | `eitbench/Pipe2DUnknownVelocity-v0` | parabolic, mean 3 … 6.5 m/s (thesis example 1) | 1 |
    | `eitbench/Pipe2DTimeVaryingVelocity-v0` | parabolic, its mean a sine in time of 20 … 35 % (example 2) | 1 |
    | `eitbench/Pipe2DSkewedVelocity-v0` | not symmetric, no combination of the three φ_k (example 3) | 3 |

    ## Action space

    `Box((1701 + k,), float64)`: the estimate at the nodes of `task.mesh` in mol/m³, within ±250, and after it θ in m/s,
    within ±45. Ignored while i ≤ lag.

    ## Observation space

    As in `eitbench/Pipe2D-v0`: `voltages` in V and `currents` in A per metre of depth, 16 of each.

    ## Reward

    −∫(ĉ_t − c_t)² dΩ / ∫c_t² dΩ − ∫(v̂_t − v_t)² dy / ∫v_t² dy for the 80 scored states t = 19 … 98, else 0. On the
    leaderboard the two are ẽ_c and ẽ_v; ẽ_c ranks.

    ## Starting state

    The fluid has been flowing until the slowest that may be drawn has flushed the pipe. `reset(seed=s)` plays
    episode s.

    ## Episode end

    Terminated after 98 + lag steps. Never truncated.

    ## Arguments

    | name | default | meaning |
    |---|---|---|
    | `flow` | that of the id | "unknown", "time-varying" or "skewed" |
    | `lag` | 0 | an integer from 0 to 97, or "all" (= 97): whole record first |
    | `scenario` | None | dict of the scenario's fields to change |
    | `episodes` | 1000 | number of training episodes for unseeded resets |
    | `render_mode` | None | "rgb_array": truth, estimate, spread and active pair |

    ## Version history

    * v0: first version.
    """

    def __init__(self, *, flow: str = "unknown", lag: int | str = 0, scenario: dict[str, Any] | None = None,
                 episodes: int = 1000, render_mode: str | None = None) -> None:
        EzPickle.__init__(self, flow=flow, lag=lag, scenario=scenario, episodes=episodes, render_mode=render_mode)
        super().__init__(_scenario(flow, scenario), lag=lag, episodes=episodes, render_mode=render_mode)


class Pipe2DVelocityVectorEnv(EstimationVectorEnv):
    """`Pipe2DVelocityEnv`, many times; arguments as there."""

    def __init__(self, *, num_envs: int = 1, flow: str = "unknown", lag: int | str = 0,
                 scenario: dict[str, Any] | None = None, episodes: int = 1000) -> None:
        super().__init__(_scenario(flow, scenario), num_envs, lag=lag, episodes=episodes)


def _scenario(flow: str, changes: dict[str, Any] | None) -> Pipe2DUnknownVelocity:
    if flow not in FLOWS:
        raise ValueError(f"flow must be one of {', '.join(FLOWS)}, got {flow!r}")
    return with_fields(FLOWS[flow], changes)
