"""`eitbench/StationaryTank2D-v0`."""

from __future__ import annotations

from typing import Any

from gymnasium.utils import EzPickle

from eitbench.envs.arguments import with_fields
from eitbench.envs.estimation import EstimationEnv
from eitbench.envs.estimation_vector import EstimationVectorEnv
from eitbench.worlds import StationaryTank2D


class StationaryTank2DEnv(EstimationEnv, EzPickle):
    """
    ## Description

    Two metal cylinders stand in a flat round tank of saline; nothing moves. Sixteen electrodes on the wall, one
    injection after another: estimate the concentration (which stands for the conductivity) from the first injection on.
    A Kalman filter with F = I and a smoothness prior in Γ_{0|0} has found both cylinders after about five injections
    (Seppänen 2005, 7.2, Fig. 7.4; all numbers in `eitbench.worlds.StationaryTank2D`).

    ## Action space

    `Box(-250, 250, (1261,), float64)`: the estimate of c_t at the nodes of `task.mesh`, mol/m³.

    ## Observation space

    | key | space | meaning |
    |---|---|---|
    | `voltages` | `Box((16,), float64)` | electrode potentials against their mean, V, with noise |
    | `currents` | `Box((16,), float64)` | injected currents, A per metre of depth, summing to zero |

    ## Reward

    −∫(ĉ_t − c)² dΩ / ∫c² dΩ for every t = 1 … 32: minus the mean is ẽ_c (thesis 5.12).

    ## Starting state

    Both cylinders are drawn anew for each episode. `reset(seed=s)` plays episode s.

    ## Episode end

    Terminated after 32 steps. Never truncated.

    ## Arguments

    | name | default | meaning |
    |---|---|---|
    | `scenario` | None | dict of `StationaryTank2D` fields to change |
    | `episodes` | 1000 | number of training episodes for unseeded resets |
    | `render_mode` | None | "rgb_array": truth, estimate, spread and active pair |

    ## Version history

    * v0: first version.
    """

    def __init__(self, *, scenario: dict[str, Any] | None = None, episodes: int = 1000,
                 render_mode: str | None = None) -> None:
        EzPickle.__init__(self, scenario=scenario, episodes=episodes, render_mode=render_mode)
        super().__init__(with_fields(StationaryTank2D, scenario), episodes=episodes, render_mode=render_mode)


class StationaryTank2DVectorEnv(EstimationVectorEnv):
    """`StationaryTank2DEnv`, many times; arguments as there."""

    def __init__(self, *, num_envs: int = 1, scenario: dict[str, Any] | None = None, episodes: int = 1000) -> None:
        super().__init__(with_fields(StationaryTank2D, scenario), num_envs, episodes=episodes)
