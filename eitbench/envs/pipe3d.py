"""`eitbench/Pipe3D-v0` and its smoothing sibling."""

from __future__ import annotations

from typing import Any

from gymnasium.utils import EzPickle

from eitbench.envs.arguments import with_fields
from eitbench.envs.estimation import EstimationEnv
from eitbench.envs.estimation_vector import EstimationVectorEnv
from eitbench.worlds import Pipe3D


class Pipe3DEnv(EstimationEnv, EzPickle):
    """
    ## Description

    Fluid streams through a round pipe, 40 cm long and 10 cm wide, at 4.5 m/s on average; slugs of higher and lower
    concentration enter at random. Four rings of eight electrodes on the wall, one current injection every 5 ms. From
    the voltages of each injection, and a model of flow, estimate the concentration everywhere (Seppänen 2005, 5.2,
    Fig. 5.10; all numbers in `eitbench.worlds.Pipe3D`).

    The truth is computed on finer meshes and time steps than the model in ``env.unwrapped.task``, which holds all that
    an estimator may know.

    ## Ids

    | id | asks for | board |
    |---|---|---|
    | `eitbench/Pipe3D-v0` | c_t when V_1 … V_t are known | filter |
    | `eitbench/Pipe3DSmoothing-v0` | every c_t, once the whole record has been played | smoothing |

    ## Action space

    `Box(-250, 250, (3003,), float64)`: the estimate at the nodes of `task.mesh`, mol/m³. Ignored while i ≤ lag.

    ## Observation space

    `Dict`, zeros once the record has been played:

    | key | space | meaning |
    |---|---|---|
    | `voltages` | `Box((32,), float64)` | electrode potentials against their mean, V, with noise |
    | `currents` | `Box((32,), float64)` | injected currents, A, summing to zero |

    ## Reward

    −∫(ĉ_t − c_t)² dΩ / ∫c_t² dΩ for the 48 scored states t = 19 … 66, else 0: minus the mean over the scored states is
    ẽ_c (thesis 5.12).

    ## Starting state

    The fluid has been flowing for one flush time. `reset(seed=s)` plays episode s. The first use of a seed simulates
    its truth (one to two minutes), which is then kept on disk; `eitbench bank` does so for many seeds ahead of time.

    ## Episode end

    Terminated after 66 + lag steps. Never truncated.

    ## Arguments

    | name | default | meaning |
    |---|---|---|
    | `electrode_rings` | 4 | rings of electrodes on the wall |
    | `electrodes_per_ring` | 8 | electrodes in each |
    | `lag` | 0 | an integer from 0 to 65, or "all" (= 65): whole record first |
    | `scenario` | None | dict of `Pipe3D` fields to change |
    | `episodes` | 1000 | number of training episodes for unseeded resets |
    | `render_mode` | None | "rgb_array": truth, estimate, spread: slices along the pipe and isosurfaces |

    ## Version history

    * v0: first version.
    """

    def __init__(self, *, electrode_rings: int = 4, electrodes_per_ring: int = 8, lag: int | str = 0,
                 scenario: dict[str, Any] | None = None, episodes: int = 1000, render_mode: str | None = None) -> None:
        EzPickle.__init__(self, electrode_rings=electrode_rings, electrodes_per_ring=electrodes_per_ring, lag=lag,
                          scenario=scenario, episodes=episodes, render_mode=render_mode)
        super().__init__(_scenario(scenario, electrode_rings, electrodes_per_ring), lag=lag, episodes=episodes,
                         render_mode=render_mode)


class Pipe3DVectorEnv(EstimationVectorEnv):
    """`Pipe3DEnv`, many times; arguments as there."""

    def __init__(self, *, num_envs: int = 1, electrode_rings: int = 4, electrodes_per_ring: int = 8,
                 lag: int | str = 0, scenario: dict[str, Any] | None = None, episodes: int = 1000) -> None:
        super().__init__(_scenario(scenario, electrode_rings, electrodes_per_ring), num_envs, lag=lag,
                         episodes=episodes)


def _scenario(changes: dict[str, Any] | None, electrode_rings: int, electrodes_per_ring: int) -> Pipe3D:
    return with_fields(Pipe3D, changes, electrode_rings=electrode_rings, electrodes_per_ring=electrodes_per_ring)
