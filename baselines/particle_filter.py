"""Rao–Blackwellised particle filter for rare slugs: a particle is a sequence of regimes, quiet or
slug, with an extended Kalman filter; `switching_inflow_filter` mixes the regimes at each step.
"""

from pathlib import Path

import numpy as np

from eitbench import Task
from eitbench.estimation import (
    FilterEstimator,
    ParticleInflowFilter,
    compatible_priors,
    linearise_at_prediction,
)

PRIORS = Path(__file__).with_name("priors")
LINK = "logarithm"
LEVEL_STD = 0.05
"""Standard deviation of the inflow between slugs, relative to the best homogeneous estimate."""
PARTICLES = 8
"""Number of particles; each branches into two regimes, so that 16 filters run."""
SEED = 0


class Estimator(FilterEstimator):
    subtracks = ("filter",)
    parameters = {"level_std": LEVEL_STD, "particles": PARTICLES, "seed": SEED}  # noqa: RUF012

    def __init__(self, task: Task) -> None:
        prior = compatible_priors(PRIORS, task, LINK)[0]
        super().__init__(task, lambda c_ref: ParticleInflowFilter(
            task, prior, c_ref, LEVEL_STD, linearise_at_prediction(task), PARTICLES,
            np.random.default_rng(SEED)))

    @staticmethod
    def suits(task: Task) -> bool:
        priors = compatible_priors(PRIORS, task, LINK)
        return task.velocity is None and bool(priors) and priors[0].regimes is not None
