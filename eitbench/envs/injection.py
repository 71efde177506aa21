"""Choose the injections: an agent selects where the current enters and leaves at every step."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from eitbench.envs.episodes import EpisodeEnv, EpisodeVectorEnv
from eitbench.envs.injection_core import InjectionCore
from eitbench.estimation.onboard.rules import Rules
from eitbench.worlds.registry import entry


class InjectionEnv(EpisodeEnv):
    """Choose the current injections of one episode; a filter inside makes the estimate.

    ## Action Space

    `Discrete(n)`: the number of an electrode pair (0, 1), (0, 2), … (`Rules.pairs`); the
    current enters at the first electrode and leaves at the second. With a budget, the last action
    omits the injection. With `instrument.readings="chosen"`, `MultiDiscrete`: the pair's number and
    the electrodes to measure. With `instrument.current_norm`, `Box`: a current for each electrode,
    relative to the instrument's current, see `Rules`.

    ## Observation Space

    By default one array with entries of about −1 to 1, limited to ±5 (`scaled`). With
    `observation="raw"` a `Dict` in SI units, `float64`, with the keys below; with
    `estimator="none"` only `voltages`, `currents` and `left`, raw.

    ## Rewards

    For each scored state ∫(ĉ_bh − c_t)² dΩ / ∫c_t² dΩ − ∫(ĉ_t − c_t)² dΩ / ∫c_t² dΩ, the error of
    the homogeneous estimate, which no injection changes, minus the filter's error; 0 for the other
    states. The score is ẽ_c (thesis 5.12), the mean of the second term; where the world has a
    `region`, both integrals are over the region. With `estimator="none"` the reward is 0. For
    scored states `info["error"]` is the second term.

    ## Starting State

    `reset(seed=s)` starts episode s; the splits train, dev and test have separate ranges of seeds.
    Without a seed, a random training episode is drawn, from few at first. The first frame is
    measured with the world's cycle of injections; from it follow ĉ_bh and the parameters of the
    filter. The agent injects after it; with `estimator="none"` it makes all injections.

    ## Episode End

    Terminated after the last injection. Never truncated.

    ## Arguments

    | name | default | meaning |
    |---|---|---|
    | `estimator` | "reduced" | reduced filter for training; "full" for scores; "none" |
    | `observation` | "scaled" | or "raw" |
    | `gate` | set by the id | the filter rejects innovations beyond this many standard deviations |
    | `inflow` | set by the id | inflow prior: "white" noise (Table 5.1), or "learned" |
    | `faults` | set by the id | electrode faults: the "gate" rejects measurements, or "estimated" |
    | `history` | set by the id | entries of the last "steps", or of the last "injections" |
    | `gains` | False | with moving bodies: observations include the A-criterion of each pair |
    | `variant` | None | name of a robustness variant of the id |
    | `world` | None | numbers to change, as in `{"schedule": {"budget": 20}}` |
    | `episodes` | None | episodes of unseeded resets; None: 1, 8, … up to 1000, of dev 32 |
    | `split` | "train" | split of unseeded resets: "train", or "dev" for evaluation |
    | `render_mode` | None | "rgb_array": truth, estimate, standard deviation, injection |
    | `threads` | 1 | vector form only: threads of the filters; give BLAS one thread then |
    """

    core: InjectionCore

    def __init__(self, name: str, *, variant: str | None = None,
                 world: dict[str, Any] | None = None, estimator: str = "reduced",
                 observation: str = "scaled", gate: float | None = None, inflow: str | None = None,
                 faults: str | None = None, history: str | None = None, gains: bool = False,
                 episodes: int | None = None, split: str = "train",
                 render_mode: str | None = None) -> None:
        core = make_core(name, variant, world, estimator, observation, gate, inflow, faults,
                         history, gains)
        super().__init__(core, episodes, split, render_mode)
        self.rules = core.rules

    def action_masks(self) -> np.ndarray:
        """(actions,) bool: numbered actions that have an effect; only the last one, without an
        injection, when the budget is used up."""
        return self.core.action_masks()[0]

    @property
    def error(self) -> float | None:
        """Relative error (5.12) of the present estimate; None without an estimator or if the state
        is not scored. ``ResetNeeded`` before the first episode."""
        self.require_reset("error")
        error = float(self.core.errors()[0])
        return None if np.isnan(error) else error


class InjectionVectorEnv(EpisodeVectorEnv):
    """`InjectionEnv`, many times; see there and `EpisodeVectorEnv`.

    Parameters
    ----------
    threads : int
        CPU cores that the filters may use; give BLAS one thread then. The numbers do not depend on
        it.
    """

    def __init__(self, name: str, *, num_envs: int = 1, episodes: int | None = None,
                 split: str = "train", render_mode: str | None = None, threads: int = 1,
                 max_episode_steps: int | None = None, **arguments: Any) -> None:
        super().__init__(partial(make_core, name, **arguments), num_envs, episodes, split,
                         render_mode, max_episode_steps, threads)
        self.rules: Rules = self.cores[0].rules

    def action_masks(self) -> np.ndarray:
        """(num_envs, actions) as in `InjectionEnv`."""
        return np.concatenate([core.action_masks() for core in self.cores])


def make_core(name: str, variant: str | None = None, world: dict[str, Any] | None = None,
              estimator: str = "reduced", observation: str = "scaled", gate: float | None = None,
              inflow: str | None = None, faults: str | None = None,
              history: str | None = None, gains: bool = False) -> InjectionCore:
    """Return the core of an id with these arguments; ``ValueError`` names an argument that is not
    allowed."""
    registered = entry(name, variant)
    given = {"gate": gate, "inflow": inflow, "faults": faults, "history": history}
    settings = dict(registered.settings) | {key: value for key, value in given.items()
                                            if value is not None}
    rules = Rules(registered.world.with_changes(world), has_first_frame=estimator != "none",
                  gains=gains, **settings)
    return InjectionCore(rules, estimator, observation)
