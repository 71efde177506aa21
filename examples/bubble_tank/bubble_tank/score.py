"""How far the estimated bubble is from the true one."""

from __future__ import annotations

import numpy as np

from eitbench.bench.scores import Outcome, Score, register_score
from eitbench.scoring import deficit_centre


def distance(outcome: Outcome) -> float | None:
    """Mean distance in m; in worlds of others there is no bubble."""
    if outcome.world.name != "BubbleTank":
        return None
    estimated, true = (
        np.array([deficit_centre(state, outcome.points, outcome.weights) for state in states])
        for states in (outcome.mean, outcome.truth))
    return np.linalg.norm(estimated - true, axis=1).mean()


register_score(Score(
    "bubble_distance", "distance", "how far the bubble is from where the estimate has it, mm",
    distance, needs=("mean", "truth"), factor=1e3))
