"""`eitbench/RotatingTank2D-v0`."""

from __future__ import annotations

from typing import Any

from gymnasium.utils import EzPickle

from eitbench.envs.arguments import with_fields
from eitbench.envs.estimation import EstimationEnv
from eitbench.envs.estimation_vector import EstimationVectorEnv
from eitbench.worlds import RotatingTank2D


class RotatingTank2DEnv(EstimationEnv, EzPickle):
    """
    ## Description

    A flat round tank of stirred saline carries a ball round that hardly conducts; sixteen electrodes on the wall. One
    pair of them injects all the time. A stationary image of one injection shows nothing, but the flow carries the
    target through the pair's field, and a filter that knows the flow can follow it (Seppänen 2005, 7.1, Figs 7.2 and
    7.3; all numbers in `eitbench.worlds.RotatingTank2D`).

    The truth is a rigid ball on a path of its own; the model in ``env.unwrapped.task`` is a liquid without any ball, in
    which concentration is carried and spreads, as in the thesis.

    ## Action space

    `Box(-250, 250, (1261,), float64)`: the estimate of c_t at the nodes of `task.mesh`, mol/m³.

    ## Observation space

    | key | space | meaning |
    |---|---|---|
    | `voltages` | `Box((16,), float64)` | electrode potentials against their mean, V, with noise |
    | `currents` | `Box((16,), float64)` | injected currents, A per metre of depth, summing to zero |

    ## Reward

    −∫(ĉ_t − c_t)² dΩ / ∫c_t² dΩ for the 64 scored states t = 17 … 80, else 0: minus the mean over the scored states is
    ẽ_c (thesis 5.12).

    ## Starting state

    The ball begins between 0.25 and 0.48 of the radius from the middle, at any angle; the flow is steady.
    `reset(seed=s)` plays episode s.

    ## Episode end

    Terminated after 80 steps. Never truncated.

    ## Arguments

    | name | default | meaning |
    |---|---|---|
    | `scenario` | None | dict of `RotatingTank2D` fields to change |
    | `episodes` | 1000 | number of training episodes for unseeded resets |
    | `render_mode` | None | "rgb_array": truth, estimate, spread and active pair |

    ## Version history

    * v0: first version.
    """

    def __init__(self, *, scenario: dict[str, Any] | None = None, episodes: int = 1000,
                 render_mode: str | None = None) -> None:
        EzPickle.__init__(self, scenario=scenario, episodes=episodes, render_mode=render_mode)
        super().__init__(with_fields(RotatingTank2D, scenario), episodes=episodes, render_mode=render_mode)


class RotatingTank2DVectorEnv(EstimationVectorEnv):
    """`RotatingTank2DEnv`, many times; arguments as there."""

    def __init__(self, *, num_envs: int = 1, scenario: dict[str, Any] | None = None, episodes: int = 1000) -> None:
        super().__init__(with_fields(RotatingTank2D, scenario), num_envs, episodes=episodes)
