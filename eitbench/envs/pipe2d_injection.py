"""`eitbench/Pipe2DInjection-v0` and `eitbench/Pipe2DInjectionCurrents-v0`."""

from __future__ import annotations

from typing import Any

from gymnasium.utils import EzPickle

from eitbench import _check
from eitbench.envs.arguments import with_fields
from eitbench.envs.injection import InjectionEnv, InjectionVectorEnv
from eitbench.envs.injection_core import Rules
from eitbench.worlds import Pipe2D
from eitbench.worlds.instrument import Instrument


def _rules(scenario: dict[str, Any] | None, limit: str | None, noise_floor: float) -> Rules:
    floor = _check.number("noise_floor", noise_floor, low=0.0, units="V")
    return Rules(with_fields(Pipe2D, scenario), Instrument(noise_floor=floor), limit)


class Pipe2DInjectionEnv(InjectionEnv, EzPickle):
    """
    ## Description

    The pipe of `eitbench/Pipe2D-v0`; here the agent chooses at every step how the current flows. A Kalman filter inside
    takes in the voltages and estimates the concentration; it is the same for every agent, so that agents differ only in
    what they inject.

    This is the reference case, not a competition: one pair near the inlet, injected for ever, is as good as anything
    (what is known at the inlet the flow carries through the whole pipe), and what to inject does not depend on what is
    measured. The adaptivity gap is 0.01 (`docs/injection.md`).

    `eitbench/Pipe2DInjectionCurrents-v0` is the same world with a current of its own for each electrode, and as much a
    reference: the best currents, the same at every step, take a tenth off the ẽ_c of any pairs, and the clairvoyant
    2 % more. There the gap is 0.02.

    ## Action space

    `Discrete(120)`: the electrode pairs (0, 1), (0, 2), …, (14, 15) in this order
    (`electrode_pairs`); current enters at the first and leaves at the second. Electrodes 0 … 7
    lie on the lower wall, 8 … 15 on the upper one, both along the flow.

    With `limit`: `Box(-1, 1, (16,), float32)`, currents in parts of the instrument's 0.1 A/m. Their mean is taken away
    (Σ I = 0); if they then exceed the limit, they are scaled down to it. The limit is the norm of a pair: Σ|I| ≤ 2
    ("L1", a total current), Σ I² ≤ 2 ("L2", a power) or |I| ≤ 1 ("Linf", a source for each electrode).

    ## Observation space

    `Box(-5, 5, (201,), float32)`, about between −1 and 1 (`eitbench.envs.injection_core.scaled`); with
    `observation="raw"` a dict in SI units, `float64`:

    | key | shape | meaning |
    |---|---|---|
    | `voltages` | (16,) | last measured potentials against their mean, V, with noise |
    | `currents` | (16,) | currents asked for then, A per metre of depth |
    | `recent` | (4, 16) | the last four of these, the last first |
    | `frame` | (16, 16) | voltages of the first frame; not in the scaled observation |
    | `innovations` | (16,) | measured less predicted, in predicted standard deviations |
    | `mean` | (36,) | estimate on 12 × 3 patches, along the flow first, mol/m³ |
    | `std` | (36,) | its standard deviation, mol/m³ |
    | `doubt` | (2, 16) | how often lately an electrode's readings were not believed, and injections it drove |
    | `left` | (1,) | steps left |

    With `estimator="none"` `voltages`, `currents` and `left` only, raw.

    ## Reward

    For the 80 scored states, else 0: ∫(ĉ_bh − c_t)² dΩ / ∫c_t² dΩ − ∫(ĉ_t − c_t)² dΩ / ∫c_t² dΩ, by how much the error
    lies below that of the homogeneous estimate, which no injection can change. The score is ẽ_c (thesis 5.12), the mean
    of the second term. With `estimator="none"` the reward is always 0.

    ## Starting state

    The first frame of 16 injections is measured with the thesis-like cycle of `eitbench/Pipe2D-v0`; the agent takes
    over at the 17th. With `estimator="none"` it chooses from the first one on.

    ## Episode end

    Terminated after 82 steps (98 with `estimator="none"`). Never truncated.

    ## Arguments

    | name | default | meaning |
    |---|---|---|
    | `estimator` | "reduced" | "reduced": a filter with 120 states, for training; "full": the exact one; "none" |
    | `observation` | "scaled" | or "raw" |
    | `limit` | None | "L1", "L2" or "Linf": actions are currents |
    | `noise_floor` | 0 | V; std of an absolute noise, 2e-4 in the variant with currents |
    | `scenario` | None | dict of `Pipe2D` fields to change |
    | `episodes` | 1000 | number of training episodes for unseeded resets |
    | `render_mode` | None | "rgb_array": truth, estimate, spread, injection |
    | `threads` | 1 | vectorised only: cores that the filters may use; give BLAS one thread then |

    The first use of a scenario makes the reduced model (half a minute), which is then kept on disk.

    ## Version history

    * v0: first version.
    """

    def __init__(self, *, estimator: str = "reduced", observation: str = "scaled", limit: str | None = None,
                 noise_floor: float = 0.0, scenario: dict[str, Any] | None = None, episodes: int = 1000,
                 render_mode: str | None = None) -> None:
        EzPickle.__init__(self, estimator=estimator, observation=observation, limit=limit, noise_floor=noise_floor,
                          scenario=scenario, episodes=episodes, render_mode=render_mode)
        super().__init__(_rules(scenario, limit, noise_floor), estimator=estimator, observation=observation,
                         episodes=episodes, render_mode=render_mode)


class Pipe2DInjectionVectorEnv(InjectionVectorEnv):
    """`Pipe2DInjectionEnv`, many times: ``gym.make_vec("eitbench/Pipe2DInjection-v0", num_envs=64)``."""

    def __init__(self, *, num_envs: int = 1, estimator: str = "reduced", observation: str = "scaled",
                 limit: str | None = None, noise_floor: float = 0.0, scenario: dict[str, Any] | None = None,
                 episodes: int = 1000, threads: int = 1) -> None:
        super().__init__(_rules(scenario, limit, noise_floor), num_envs, estimator=estimator, observation=observation,
                         episodes=episodes, threads=threads)
