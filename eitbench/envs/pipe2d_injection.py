"""`eitbench/Pipe2DInjection-v0`."""

from __future__ import annotations

from typing import Any

from gymnasium.utils import EzPickle

from eitbench.envs.arguments import with_fields
from eitbench.envs.injection import InjectionEnv, InjectionVectorEnv
from eitbench.scenarios import Pipe2D


class Pipe2DInjectionEnv(InjectionEnv, EzPickle):
    """
    ## Description

    The pipe of `eitbench/Pipe2D-v0`; here the agent chooses at every step between which two of the sixteen electrodes
    the current flows. A Kalman filter inside takes in the voltages and estimates the concentration; it is the same
    for every agent, so that agents differ only in what they inject.

    ## Action space

    `Discrete(120)`: the electrode pairs (0, 1), (0, 2), …, (14, 15) in this order
    (`eitbench.envs.operator.electrode_pairs`); current enters at the first and leaves at the second. Electrodes 0 … 7
    lie on the lower wall, 8 … 15 on the upper one, both along the flow.

    ## Observation space

    | key | space | meaning |
    |---|---|---|
    | `voltages` | `Box((16,), float64)` | last measured potentials against their mean, V, with noise |
    | `currents` | `Box((16,), float64)` | currents injected then, A per metre of depth |
    | `innovations` | `Box((16,), float64)` | measured less predicted, in predicted standard deviations |
    | `mean` | `Box((36,), float64)` | estimate on 12 × 3 patches, along the flow first, mol/m³ |
    | `std` | `Box((36,), float64)` | its standard deviation, mol/m³ |

    With `estimator="none"` the first two only.

    ## Reward

    −∫(ĉ_t − c_t)² dΩ / ∫c_t² dΩ for the 80 scored states, else 0: minus its sum, divided by 80, is ẽ_c (thesis 5.12).
    With `estimator="none"` always 0.

    ## Starting state

    The first frame of 16 injections is measured with the thesis-like cycle of `eitbench/Pipe2D-v0`; the agent takes
    over at the 17th. With `estimator="none"` it chooses from the first one on.

    ## Episode end

    Terminated after 82 steps (98 with `estimator="none"`). Never truncated.

    ## Arguments

    | name | default | meaning |
    |---|---|---|
    | `estimator` | "reduced" | "reduced": a Kalman filter with 120 states; "none": no estimator |
    | `scenario` | None | dict of `Pipe2D` fields to change |
    | `episodes` | 1000 | number of training episodes for unseeded resets |
    | `render_mode` | None | none yet |
    | `threads` | 1 | vectorised only: cores that the filters may use; give BLAS one thread then |

    The first use of a scenario makes the reduced model (half a minute), which is then kept on disk.

    ## Version history

    * v0: first version.
    """

    def __init__(self, *, estimator: str = "reduced", scenario: dict[str, Any] | None = None, episodes: int = 1000,
                 render_mode: str | None = None) -> None:
        EzPickle.__init__(self, estimator=estimator, scenario=scenario, episodes=episodes, render_mode=render_mode)
        super().__init__(with_fields(Pipe2D, scenario), estimator=estimator, episodes=episodes, render_mode=render_mode)


class Pipe2DInjectionVectorEnv(InjectionVectorEnv):
    """`Pipe2DInjectionEnv`, many times: ``gym.make_vec("eitbench/Pipe2DInjection-v0", num_envs=64)``."""

    def __init__(self, *, num_envs: int = 1, estimator: str = "reduced", scenario: dict[str, Any] | None = None,
                 episodes: int = 1000, threads: int = 1) -> None:
        super().__init__(with_fields(Pipe2D, scenario), num_envs, estimator=estimator, episodes=episodes,
                         threads=threads)
