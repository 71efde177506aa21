"""`eitbench/Pipe2DInjectionFlow-v0`."""

from __future__ import annotations

from typing import Any

from gymnasium.utils import EzPickle

from eitbench.envs.arguments import with_fields
from eitbench.envs.injection import InjectionEnv, InjectionVectorEnv
from eitbench.envs.injection_core import Rules
from eitbench.scenarios import Pipe2DDriftingVelocity


def _rules(region: list[float] | None, scenario: dict[str, Any] | None) -> Rules:
    return Rules(with_fields(Pipe2DDriftingVelocity, scenario, region=region))


class Pipe2DInjectionFlowEnv(InjectionEnv, EzPickle):
    """
    ## Description

    The pipe of `eitbench/Pipe2D-v0` with a mean velocity that nobody knows and that drifts, a random walk between 2.5
    and 6.5 m/s (`Pipe2DDriftingVelocity`). Only what flows through a region of interest counts, by default the last 12
    cm. The filter inside estimates concentration and mean velocity together (the joint extended Kalman filter of the
    thesis' chapter 6). Slugs may be looked at when they enter, on the way or when they arrive; what is known of one
    that has entered is worth no more than what is known of the flow that carries it.

    This is a competition case: the adaptivity gap is 1.07, with a 95 % interval from 0.85 to 1.36 over 50 dev episodes.
    No hand-written policy that looks at the data has beaten random pairs, which are as good as the best cycle; trained
    agents do (`docs/injection.md`).

    ## Action space

    `Discrete(120)`: electrode pairs as in `eitbench/Pipe2DInjection-v0`.

    ## Observation space

    As in `eitbench/Pipe2DInjection-v0`, and two more keys: `velocity`, (1,), the estimated mean velocity in m/s, and
    `velocity_std`, (1,), its standard deviation. The scaled observation has 203 entries, these two last.

    ## Reward

    For the 80 scored states, else 0: as in `eitbench/Pipe2DInjection-v0`, but all integrals are over the region, in the
    numerator and in the denominator: ∫(ĉ_bh − c_t)² / ∫c_t² − ∫(ĉ_t − c_t)² / ∫c_t². The score is the mean of the
    second term. What the velocity's estimate is worth shows in the concentration only.

    ## Starting state

    The fluid has been flowing until the slowest has flushed the pipe. The first frame of 16 injections is measured with
    the thesis-like cycle of `eitbench/Pipe2D-v0`; the filter starts from 4.5 ± 1 m/s.

    ## Episode end

    Terminated after 82 steps (98 with `estimator="none"`). Never truncated.

    ## Arguments

    | name | default | meaning |
    |---|---|---|
    | `region` | [0.28, 0.40] | m along the pipe, multiples of 0.01; None: the whole pipe counts |
    | `scenario` | None | dict of `Pipe2DDriftingVelocity` fields to change |
    | `estimator`, `observation`, `episodes`, `render_mode`, `threads` | | as in `Pipe2DInjection-v0` |

    Both filters linearise the voltages about the level of the first frame. `estimator="full"` takes some
    0.6 s a step. Each region has its own recordings. The first use of a scenario makes the reduced model (a minute).

    ## Version history

    * v0: first version.
    """

    def __init__(self, *, estimator: str = "reduced", observation: str = "scaled",
                 region: list[float] | None = [0.28, 0.40], scenario: dict[str, Any] | None = None,  # noqa: B006
                 episodes: int = 1000, render_mode: str | None = None) -> None:
        EzPickle.__init__(self, estimator=estimator, observation=observation, region=region, scenario=scenario,
                          episodes=episodes, render_mode=render_mode)
        super().__init__(_rules(region, scenario), estimator=estimator, observation=observation, episodes=episodes,
                         render_mode=render_mode)


class Pipe2DInjectionFlowVectorEnv(InjectionVectorEnv):
    """`Pipe2DInjectionFlowEnv`, many times: ``gym.make_vec("eitbench/Pipe2DInjectionFlow-v0", num_envs=64)``."""

    def __init__(self, *, num_envs: int = 1, estimator: str = "reduced", observation: str = "scaled",
                 region: list[float] | None = [0.28, 0.40], scenario: dict[str, Any] | None = None,  # noqa: B006
                 episodes: int = 1000, threads: int = 1) -> None:
        super().__init__(_rules(region, scenario), num_envs, estimator=estimator, observation=observation,
                         episodes=episodes, threads=threads)
