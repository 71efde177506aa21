"""`eitbench/RotatingTankInjection-v0`."""

from __future__ import annotations

from typing import Any

from gymnasium.utils import EzPickle

from eitbench.envs.arguments import with_fields
from eitbench.envs.injection import InjectionEnv, InjectionVectorEnv
from eitbench.envs.injection_core import Rules
from eitbench.worlds import RotatingTank2D


class RotatingTankInjectionEnv(InjectionEnv, EzPickle):
    """
    ## Description

    The stirred tank of `eitbench/RotatingTank2D-v0`: a ball that hardly conducts is carried round on a path that nobody
    knows beforehand. Here the agent chooses which pair of electrodes injects. The filter inside knows the liquid's flow
    and of no ball.

    This is a reference case, not a competition: the liquid carries the ball past every pair, between random pairs and
    the clairvoyant there are 8 % of ẽ_c, and no policy that looks at the data has beaten the best pair. The adaptivity
    gap is 0.32, with a 95 % interval from 0.21 to 0.50 over 50 dev episodes, a quotient of small numbers
    (`docs/injection.md`).

    ## Action space

    `Discrete(120)`: electrode pairs (0, 1), (0, 2), …, (14, 15); electrodes are numbered round the wall.

    ## Observation space

    As in `eitbench/Pipe2DInjection-v0`, but for the patches, which are 6 × 6 over the tank's bounding square, and the
    first frame, which is one injection of 0 → 8. The scaled observation has 201 entries.

    ## Reward

    As in `eitbench/Pipe2DInjection-v0`, for the 64 scored states.

    ## Starting state

    The ball begins between 0.25 and 0.48 of the radius from the middle, at any angle. The first injection is 0 → 8.

    ## Episode end

    Terminated after 79 steps (80 with `estimator="none"`). Never truncated.

    ## Arguments

    | name | default | meaning |
    |---|---|---|
    | `scenario` | None | dict of `RotatingTank2D` fields to change |
    | `estimator`, `observation`, `episodes`, `render_mode`, `threads` | | as in `Pipe2DInjection-v0` |

    ## Version history

    * v0: first version.
    """

    def __init__(self, *, estimator: str = "reduced", observation: str = "scaled",
                 scenario: dict[str, Any] | None = None, episodes: int = 1000, render_mode: str | None = None) -> None:
        EzPickle.__init__(self, estimator=estimator, observation=observation, scenario=scenario, episodes=episodes,
                          render_mode=render_mode)
        super().__init__(Rules(with_fields(RotatingTank2D, scenario)), estimator=estimator, observation=observation,
                         episodes=episodes, render_mode=render_mode)


class RotatingTankInjectionVectorEnv(InjectionVectorEnv):
    """`RotatingTankInjectionEnv`, many times: ``gym.make_vec("eitbench/RotatingTankInjection-v0", num_envs=64)``."""

    def __init__(self, *, num_envs: int = 1, estimator: str = "reduced", observation: str = "scaled",
                 scenario: dict[str, Any] | None = None, episodes: int = 1000, threads: int = 1) -> None:
        super().__init__(Rules(with_fields(RotatingTank2D, scenario)), num_envs, estimator=estimator,
                         observation=observation, episodes=episodes, threads=threads)
