"""`eitbench/Pipe2D-v0` and its lagged siblings."""

from __future__ import annotations

from typing import Any

from gymnasium.utils import EzPickle

from eitbench.envs.arguments import assumed_flow, with_fields
from eitbench.envs.estimation import EstimationEnv
from eitbench.envs.estimation_vector import EstimationVectorEnv
from eitbench.worlds import Pipe2D


class Pipe2DEnv(EstimationEnv, EzPickle):
    """
    ## Description

    Fluid streams through a straight 2D pipe, 40 cm long and 10 cm wide, at 4.5 m/s on average; slugs of higher and
    lower concentration enter at random. Sixteen electrodes on the walls, one current injection every 5 ms: while a
    frame of 16 injections is measured, the fluid moves on by 36 cm. From the voltages of each injection, and a model
    of flow, estimate the concentration everywhere (Seppänen 2005, ch. 5; all numbers in `eitbench.worlds.Pipe2D`).

    The truth is computed on finer meshes and time steps than the model in ``env.unwrapped.task``, which holds all that
    an estimator may know.

    ## Ids

    | id | asks for | board |
    |---|---|---|
    | `eitbench/Pipe2D-v0` | c_t when V_1 … V_t are known | filter |
    | `eitbench/Pipe2DFixedLag-v0` | c_{t−4} when V_1 … V_t are known | fixed-lag |
    | `eitbench/Pipe2DSmoothing-v0` | every c_t, once the whole record has been played | smoothing |

    ## Action space

    `Box(-250, 250, (1701,), float64)`: the estimate at the nodes of `task.mesh`, mol/m³. Ignored while i ≤ lag.

    ## Observation space

    `Dict`, zeros once the record has been played:

    | key | space | meaning |
    |---|---|---|
    | `voltages` | `Box((16,), float64)` | electrode potentials against their mean, V, with noise |
    | `currents` | `Box((16,), float64)` | injected currents, A per metre of depth, summing to zero |

    ## Reward

    −∫(ĉ_t − c_t)² dΩ / ∫c_t² dΩ for the 80 scored states t = 19 … 98, else 0: minus the mean over the scored states
    is ẽ_c (thesis 5.12). The homogeneous estimate scores about 0.02, a Kalman filter about 0.0045.

    ## Starting state

    The fluid has been flowing for one flush time. `reset(seed=s)` plays episode s (`eitbench.data.seeds`: train,
    dev and test ranges); without a seed a random one of the first `episodes` training episodes. The first use of a seed
    simulates its truth (about 2 s), which is then kept on disk; `eitbench bank` does so for many seeds ahead of time.

    ## Episode end

    Terminated after 98 + lag steps. Never truncated.

    ## Arguments

    | name | default | meaning |
    |---|---|---|
    | `lag` | 0 | an integer from 0 to 97, or "all" (= 97): whole record first |
    | `assumed_mean_velocity` | None | m/s; what the task's model believes; None: the truth |
    | `scenario` | None | dict of `Pipe2D` fields to change |
    | `episodes` | 1000 | number of training episodes for unseeded resets |
    | `render_mode` | None | "rgb_array": truth, estimate, spread and active pair |

    ## Version history

    * v0: first version.
    """

    def __init__(self, *, lag: int | str = 0, assumed_mean_velocity: float | None = None,
                 scenario: dict[str, Any] | None = None, episodes: int = 1000, render_mode: str | None = None) -> None:
        EzPickle.__init__(self, lag=lag, assumed_mean_velocity=assumed_mean_velocity, scenario=scenario,
                          episodes=episodes, render_mode=render_mode)
        super().__init__(with_fields(Pipe2D, scenario), lag=lag, assumptions=assumed_flow(assumed_mean_velocity),
                         episodes=episodes, render_mode=render_mode)


class Pipe2DVectorEnv(EstimationVectorEnv):
    """`Pipe2DEnv`, many times: ``gym.make_vec("eitbench/Pipe2D-v0", num_envs=64)``; arguments as there."""

    def __init__(self, *, num_envs: int = 1, lag: int | str = 0, assumed_mean_velocity: float | None = None,
                 scenario: dict[str, Any] | None = None, episodes: int = 1000) -> None:
        assumed_flow(assumed_mean_velocity)              # what estimators believe changes nothing here
        super().__init__(with_fields(Pipe2D, scenario), num_envs, lag=lag, episodes=episodes)
