"""`eitbench/Pipe2DInjectionFaults-v0`."""

from __future__ import annotations

from typing import Any

from gymnasium.utils import EzPickle

from eitbench.envs.arguments import with_fields
from eitbench.envs.injection import InjectionEnv, InjectionVectorEnv
from eitbench.envs.injection_core import Rules
from eitbench.worlds import Pipe2D
from eitbench.worlds.instrument import Instrument

GATE = 8.0
"""Standard deviations beyond which the estimator does not believe a reading: slugs do not reach them."""
NOISE_FLOOR, INTERFERENCE = 1e-4, 0.5


def _rules(scenario: dict[str, Any] | None, dead: list[int], failing: list[int], loose: list[int]) -> Rules:
    instrument = with_fields(Instrument, {"noise_floor": NOISE_FLOOR, "interference": INTERFERENCE, "dead": dead,
                                          "failing": failing, "loose": loose})
    return Rules(with_fields(Pipe2D, scenario), instrument, gate=GATE)


class Pipe2DInjectionFaultsEnv(InjectionEnv, EzPickle):
    """
    ## Description

    `eitbench/Pipe2DInjection-v0` with an instrument that is falling apart. In every episode other electrodes are dead
    from the beginning, others fail on the way, others have a bad contact, and nobody announces it. A current that would
    have to pass a broken wire does not flow; the reading of such an electrode is interference. The filter inside leaves
    out readings that are further than 8 standard deviations from its prediction, and a whole injection if that is so of
    more than a third of its readings.

    Which pair is best depends on the episode, and the measurements tell: the adaptivity gap is 0.48, with a 95 %
    interval from 0.30 to 0.69 over 50 dev episodes (`docs/injection.md`).

    ## Action space

    `Discrete(120)`: electrode pairs as in `eitbench/Pipe2DInjection-v0`.

    ## Observation space

    As in `eitbench/Pipe2DInjection-v0`; `doubt` and `innovations` show what is broken.

    ## Reward

    As in `eitbench/Pipe2DInjection-v0`.

    ## Starting state

    The first frame of 16 injections is measured with the thesis-like cycle of `eitbench/Pipe2D-v0`, with the faults.

    ## Episode end

    Terminated after 82 steps (98 with `estimator="none"`). Never truncated.

    ## Arguments

    | name | default | meaning |
    |---|---|---|
    | `dead` | [2, 4] | least and most electrodes whose wire is broken from the beginning |
    | `failing` | [1, 2] | and that break on the way |
    | `loose` | [0, 2] | and with a bad contact: 0.5 to 2 Ω·m more (a sound one has 0.08), five times the noise |
    | `estimator`, `observation`, `scenario`, `episodes`, `render_mode`, `threads` | | as in the sound pipe |

    Besides the relative noise the instrument has 0.1 mV of absolute noise, and broken wires read 0.5 V (std) of
    interference, about as much as the largest voltages.

    ## Version history

    * v0: first version.
    """

    def __init__(self, *, estimator: str = "reduced", observation: str = "scaled", dead: list[int] = [2, 4],  # noqa: B006
                 failing: list[int] = [1, 2], loose: list[int] = [0, 2],  # noqa: B006
                 scenario: dict[str, Any] | None = None, episodes: int = 1000, render_mode: str | None = None) -> None:
        EzPickle.__init__(self, estimator=estimator, observation=observation, dead=dead, failing=failing, loose=loose,
                          scenario=scenario, episodes=episodes, render_mode=render_mode)
        super().__init__(_rules(scenario, dead, failing, loose), estimator=estimator, observation=observation,
                         episodes=episodes, render_mode=render_mode)


class Pipe2DInjectionFaultsVectorEnv(InjectionVectorEnv):
    """`Pipe2DInjectionFaultsEnv`, many times: ``gym.make_vec("eitbench/Pipe2DInjectionFaults-v0", num_envs=64)``."""

    def __init__(self, *, num_envs: int = 1, estimator: str = "reduced", observation: str = "scaled",
                 dead: list[int] = [2, 4], failing: list[int] = [1, 2], loose: list[int] = [0, 2],  # noqa: B006
                 scenario: dict[str, Any] | None = None, episodes: int = 1000, threads: int = 1) -> None:
        super().__init__(_rules(scenario, dead, failing, loose), num_envs, estimator=estimator,
                         observation=observation, episodes=episodes, threads=threads)
