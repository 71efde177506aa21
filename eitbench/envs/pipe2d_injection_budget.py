"""`eitbench/Pipe2DInjectionBudget-v0`."""

from __future__ import annotations

from typing import Any

from gymnasium.utils import EzPickle

from eitbench.envs.arguments import with_fields
from eitbench.envs.injection import InjectionEnv, InjectionVectorEnv
from eitbench.envs.injection_core import Rules
from eitbench.worlds import Pipe2DIntermittent


class Pipe2DInjectionBudgetEnv(InjectionEnv, EzPickle):
    """
    ## Description

    The pipe of `eitbench/Pipe2D-v0` when slugs are rare: strong ones come one at a time, at times nobody foresees,
    about three in an episode (`Pipe2DIntermittent`). The agent may inject at one step in six only, so it has to notice
    that a slug has come and then look closely, and to keep something for the next one. The adaptivity gap is 0.46, with
    a 95 % interval from 0.41 to 0.51 over 50 dev episodes (`docs/injection.md`).

    ## Action space

    `Discrete(121)`: electrode pairs as in `eitbench/Pipe2DInjection-v0`; the last action, 120, is no injection. Once
    the budget is spent every action is that (`action_masks`).

    ## Observation space

    As in `eitbench/Pipe2DInjection-v0`, but for `left`, (2,): steps left and injections left. Where nothing is injected
    `voltages` are the amplifiers' noise (here none) and `innovations` zero. The scaled observation has 202 entries.

    ## Reward

    As in `eitbench/Pipe2DInjection-v0`, for 180 scored states. Within the budget injections cost nothing.

    ## Starting state

    The first frame of 16 injections is measured with the thesis-like cycle and does not count against the budget.

    ## Episode end

    Terminated after 182 steps (198 with `estimator="none"`). Never truncated.

    ## Arguments

    | name | default | meaning |
    |---|---|---|
    | `budget` | 30 | injections the agent may make |
    | `scenario` | None | dict of `Pipe2DIntermittent` fields to change |
    | `estimator`, `observation`, `episodes`, `render_mode`, `threads` | | as in `Pipe2DInjection-v0` |

    ## Version history

    * v0: first version.
    """

    def __init__(self, *, estimator: str = "reduced", observation: str = "scaled", budget: int = 30,
                 scenario: dict[str, Any] | None = None, episodes: int = 1000, render_mode: str | None = None) -> None:
        EzPickle.__init__(self, estimator=estimator, observation=observation, budget=budget, scenario=scenario,
                          episodes=episodes, render_mode=render_mode)
        super().__init__(Rules(with_fields(Pipe2DIntermittent, scenario), budget=budget), estimator=estimator,
                         observation=observation, episodes=episodes, render_mode=render_mode)


class Pipe2DInjectionBudgetVectorEnv(InjectionVectorEnv):
    """`Pipe2DInjectionBudgetEnv`, many times: ``gym.make_vec("eitbench/Pipe2DInjectionBudget-v0", num_envs=64)``."""

    def __init__(self, *, num_envs: int = 1, estimator: str = "reduced", observation: str = "scaled", budget: int = 30,
                 scenario: dict[str, Any] | None = None, episodes: int = 1000, threads: int = 1) -> None:
        super().__init__(Rules(with_fields(Pipe2DIntermittent, scenario), budget=budget), num_envs, estimator=estimator,
                         observation=observation, episodes=episodes, threads=threads)
