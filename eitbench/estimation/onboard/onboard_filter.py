"""Filter inside an injection environment, and its features for the observation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from eitbench import _check
from eitbench.estimation.onboard.body_filters import BodyFilters, FullBodyFilters
from eitbench.estimation.onboard.episode_filters import EpisodeFilters
from eitbench.estimation.onboard.full_filters import FullFilters
from eitbench.estimation.onboard.reduced_filters import ReducedFilters

if TYPE_CHECKING:
    from eitbench.estimation.onboard.rules import Rules

ESTIMATOR_OPTIONS = ("reduced", "full", "none")
"""Reduced filter for training, full filter for scores, or no filter."""
FAULT_EMA_WEIGHT = 0.2
"""Weight of the last injection in the moving average of the fraction of rejected measurements."""


def filters_class(rules: Rules, estimator: str) -> type[EpisodeFilters] | None:
    """Return the filters' class for one of `ESTIMATOR_OPTIONS`, None for "none". ``ValueError`` for
    another option, or if the rules have a learned inflow that the world does not permit."""
    _check.choice("estimator", estimator, ESTIMATOR_OPTIONS)
    if estimator == "none":
        return None
    if rules.inflow == "learned":
        if not hasattr(rules.world.target, "draw_inflow"):
            raise ValueError("inflow must be 'white' for a target without inflow, got 'learned' "
                             f"for the target {type(rules.world.target).__name__}")
        if rules.world.velocity_model is not None:
            raise ValueError("inflow must be 'white' where the velocity is estimated too, "
                             f"got {rules.inflow!r}")
    if rules.tracks_body:
        return BodyFilters if estimator == "reduced" else FullBodyFilters
    return ReducedFilters if estimator == "reduced" else FullFilters


class OnboardFilter:
    """Filters of B episodes with their last innovations and the fault scores of electrodes.

    Parameters
    ----------
    kind : type of EpisodeFilters, from `filters_class`
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
        # Fault scores of each electrode: moving averages of the fraction of rejected measurements
        # at it, and of failed injections through it.
        reading = self._doubt[:, 0]
        driving = self._doubt[:, 1]
        injected = currents.any(axis=1, keepdims=True)
        drives = currents != 0.0
        failed = ~accepted.any(axis=1, keepdims=True)
        # A failed injection has no information on the measuring electrodes.
        reading += FAULT_EMA_WEIGHT * (injected & ~failed) * (~accepted - reading)
        driving += FAULT_EMA_WEIGHT * drives * (failed - driving)

    def features(self) -> dict[str, np.ndarray]:
        """Return innovations (B, L) in predicted standard deviations, mean and std (B, patches) in
        mol/m³, the fault scores doubt (B, 2, L), and, if estimated, velocity and its std in m/s, or
        `BODY`."""
        mean, std = self.filters.coarse_grid()
        shown = {"innovations": self._innovations.copy(), "mean": mean, "std": std,
                 "doubt": self._doubt.copy()}
        if (flow := self.filters.velocity()) is not None:
            shown |= {"velocity": flow[0], "velocity_std": flow[1]}
        if (body := self.filters.body()) is not None:
            shown["body"] = body
        return shown
