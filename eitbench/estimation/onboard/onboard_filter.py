"""Filter inside an injection environment, and its features for the observation."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

from eitbench.estimation.onboard.full_filters import FullFilters
from eitbench.estimation.onboard.reduced_filters import ReducedFilters

if TYPE_CHECKING:
    from eitbench.estimation.onboard.innovation import Innovation
    from eitbench.estimation.onboard.rules import Rules

ESTIMATOR_OPTIONS = ("reduced", "full", "none")
"""Reduced filter for training, exact filter for scores, or no filter."""
FAULT_EMA_WEIGHT = 0.2
"""Weight of the last injection in the moving average of the fraction of rejected measurements."""


class EpisodeFilters(Protocol):
    """Filters of B episodes, which start at t = 0 with c_ref of the first frame."""

    c_ref: np.ndarray
    """(B,) ĉ_bh in mol/m³"""

    def __init__(self, rules: Rules, frames: np.ndarray) -> None:
        """Assimilate the first frame, voltages (B, K, L) in V of the world's cycle."""

    def assimilate(self, voltages: np.ndarray,
                   currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Predict and condition on voltages (B, L) in V for currents (B, L), all zero without an
        injection; return the innovations in predicted standard deviations and the mask of accepted
        measurements, both (B, L)."""

    def innovations(self) -> list[Innovation | None]:
        """Return the last innovation of each episode, for scores; None without an injection or an
        accepted measurement."""

    def coarse_grid(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation (B, patches) in mol/m³ on the coarse grid."""

    def errors(self, moments: np.ndarray, deviations: np.ndarray,
               squares: np.ndarray) -> np.ndarray:
        """Return relative errors (5.12) of the present means, from moments (B, …) after `project`.
        """

    def means(self) -> np.ndarray:
        """Return estimates (B, n) in mol/m³ on the task's mesh."""

    def stds(self) -> np.ndarray:
        """Return standard deviations (B, n) of the estimates in mol/m³."""

    def velocity(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return velocity parameters θ and their standard deviations (B, k) in m/s; None if the
        task specifies the velocity."""

    @staticmethod
    def project(rules: Rules, moment: np.ndarray) -> np.ndarray:
        """Return moments (T, n) over the scored region in the form for `errors`; see
        `eitbench.data.episode_cache.ScoreIntegrals`."""


def filters_class(rules: Rules, estimator: str) -> type[EpisodeFilters] | None:
    """Return the class for a name, None for "none"; ``ValueError`` if it does not exist for these
    rules."""
    if estimator not in ESTIMATOR_OPTIONS:
        raise ValueError(f"estimator must be one of {', '.join(ESTIMATOR_OPTIONS)}, "
                         f"got {estimator!r}")
    if estimator == "none":
        return None
    if rules.inflow == "learned":
        if not hasattr(rules.world.target, "draw_inflow"):
            raise ValueError("inflow must be 'white' for a target without inflow, got 'learned' "
                             f"and a target {type(rules.world.target).__name__}")
        if rules.world.velocity_model is not None:
            raise ValueError("inflow must be 'white' where the velocity is estimated too, "
                             f"got {rules.inflow!r}")
    return ReducedFilters if estimator == "reduced" else FullFilters


class OnboardFilter:
    """Filters of B episodes with their last innovations and the fault scores of electrodes.

    Parameters
    ----------
    kind : type of EpisodeFilters
    rules : Rules
    frames : (B, K, L)
        Voltages in V of the first frame.
    """

    def __init__(self, kind: type[EpisodeFilters], rules: Rules, frames: np.ndarray) -> None:
        self.filters = kind(rules, frames)
        B, _, L = frames.shape
        self._innovations = np.zeros((B, L))
        self._doubt = np.zeros((B, 2, L))

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> None:
        """Assimilate voltages (B, L) in V of one step, for currents (B, L) in A (A/m in 2D)."""
        self._innovations, accepted = self.filters.assimilate(voltages, currents)
        # Recent fraction per electrode of rejected measurements, and of failed injections through
        # it.
        reading = self._doubt[:, 0]
        driving = self._doubt[:, 1]
        injected = currents.any(axis=1, keepdims=True)
        drives = currents != 0.0
        failed = ~accepted.any(axis=1, keepdims=True)
        # A failed injection has no information on the measuring electrodes.
        reading += FAULT_EMA_WEIGHT * (injected & ~failed) * (~accepted - reading)
        driving += FAULT_EMA_WEIGHT * drives * (failed - driving)

    def features(self) -> dict[str, np.ndarray]:
        """Return arrays (B, …): innovations, mean, std, doubt (fault scores), and if the velocity
        is estimated, its mean and standard deviation."""
        mean, std = self.filters.coarse_grid()
        shown = {"innovations": self._innovations.copy(), "mean": mean, "std": std,
                 "doubt": self._doubt.copy()}
        if (flow := self.filters.velocity()) is not None:
            shown |= {"velocity": flow[0], "velocity_std": flow[1]}
        return shown
