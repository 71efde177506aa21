"""Score of the position of the bubble."""

from __future__ import annotations

import numpy as np

from eitbench.bench.scores import Outcome, Score, register_score
from eitbench.scoring import deficit_centroid


def mean_distance(outcome: Outcome) -> float | None:
    """Return the mean distance of the estimated from the true bubble in m; None in other worlds."""
    if outcome.world.name != "BubbleTank":
        return None
    estimated, true = (
        np.array([deficit_centroid(state, outcome.points, outcome.weights) for state in states])
        for states in (outcome.mean, outcome.truth))
    return np.linalg.norm(estimated - true, axis=1).mean()


register_score(Score(
    "bubble_distance", "distance", "mean distance of the estimated from the true bubble, mm",
    mean_distance, requires=("mean", "truth"), factor=1e3))
