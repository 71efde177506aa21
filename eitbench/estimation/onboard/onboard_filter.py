"""Choice of the filter inside an injection environment."""

from __future__ import annotations

from typing import TYPE_CHECKING

from eitbench import _check
from eitbench.estimation.onboard.body_filters import BodyFilters, FullBodyFilters
from eitbench.estimation.onboard.episode_filters import EpisodeFilters
from eitbench.estimation.onboard.full_filters import FullFilters
from eitbench.estimation.onboard.reduced_filters import ReducedFilters

if TYPE_CHECKING:
    from eitbench.estimation.onboard.rules import Rules

ESTIMATOR_OPTIONS = ("reduced", "full", "none")
"""Reduced filter for training, full filter for scores, or no filter."""


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
