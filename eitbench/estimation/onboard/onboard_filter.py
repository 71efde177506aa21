"""The filter inside an injection environment, and what an agent is shown of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

from eitbench.estimation.onboard.full_filters import FullFilters
from eitbench.estimation.onboard.reduced_filters import ReducedFilters

if TYPE_CHECKING:
    from eitbench.estimation.onboard.innovation import Innovation
    from eitbench.estimation.onboard.rules import Rules

ESTIMATORS = ("reduced", "full", "none")
"""Names: reduced filter for training, exact filter for scores, or no filter."""
DOUBT = 0.2
"""Weight of the last injection in the running share of readings that were rejected."""


class EpisodeFilters(Protocol):
    """Filters of B episodes, which start from t = 0 in the level of the first frame."""

    concentration: np.ndarray
    """(B,) ĉ_bh in mol/m³"""

    def __init__(self, rules: Rules, frames: np.ndarray) -> None:
        """Take in the first frame, voltages (B, K, L) in V of the world's cycle."""

    def assimilate(self, voltages: np.ndarray,
                   currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Predict and condition on voltages (B, L) in V for currents (B, L), all zero where nothing
        was injected; return the innovations in predicted standard deviations and which readings
        were accepted, both (B, L)."""

    def innovations(self) -> list[Innovation | None]:
        """Return the last innovation of each episode, for scores; None where nothing was injected,
        or no reading was accepted."""

    def grid(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation (B, patches) in mol/m³ on the coarse grid."""

    def errors(self, moments: np.ndarray, deviations: np.ndarray,
               squares: np.ndarray) -> np.ndarray:
        """Return relative errors (5.12) of the present means, from what `project` makes of recorded
        moments (B, …)."""

    def means(self) -> np.ndarray:
        """Return estimates (B, n) in mol/m³ on the task's mesh."""

    def spreads(self) -> np.ndarray:
        """Return their standard deviations (B, n) in mol/m³."""

    def flow(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return velocity parameters θ and their standard deviations (B, k) in m/s, None where the
        flow is known."""

    @staticmethod
    def project(rules: Rules, moment: np.ndarray) -> np.ndarray:
        """Return moments over what counts (T, n), `eitbench.data.episode_cache.ScoreIntegrals`,
        as `errors`
        wants them."""


def filters_type(rules: Rules, estimator: str) -> type[EpisodeFilters] | None:
    """Return the filters of this name, None for "none"; ``ValueError`` if there are none under
    these rules."""
    if estimator not in ESTIMATORS:
        raise ValueError(f"estimator must be one of {', '.join(ESTIMATORS)}, got {estimator!r}")
    if estimator == "none":
        return None
    if rules.inflow == "learned":
        if not hasattr(rules.world.target, "draw_inflow"):
            raise ValueError("inflow must be 'white' where nothing flows in, got 'learned' and a "
                             f"target {type(rules.world.target).__name__}")
        if rules.world.velocity_model is not None:
            raise ValueError("inflow must be 'white' where the flow is to be estimated too, "
                             f"got {rules.inflow!r}")
    return ReducedFilters if estimator == "reduced" else FullFilters


class OnboardFilter:
    """Filters of B episodes with their last innovations and the doubts about electrodes.

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
        """Take in one time step with voltages (B, L) in V for currents (B, L) in A (A/m in 2D)."""
        self._innovations, accepted = self.filters.assimilate(voltages, currents)
        # Of each electrode: how often lately its own reading was rejected, and the injections that
        # it drove.
        reading = self._doubt[:, 0]
        driving = self._doubt[:, 1]
        injected = currents.any(axis=1, keepdims=True)
        drives = currents != 0.0
        failed = ~accepted.any(axis=1, keepdims=True)
        # A failed injection has no information on the electrodes that only measured.
        reading += DOUBT * (injected & ~failed) * (~accepted - reading)
        driving += DOUBT * drives * (failed - driving)

    def shown(self) -> dict[str, np.ndarray]:
        """Return arrays (B, …): innovations, mean, std, doubt, and where the flow is estimated its
        velocity and the standard deviation of that."""
        mean, std = self.filters.grid()
        shown = {"innovations": self._innovations.copy(), "mean": mean, "std": std,
                 "doubt": self._doubt.copy()}
        if (flow := self.filters.flow()) is not None:
            shown |= {"velocity": flow[0], "velocity_std": flow[1]}
        return shown
