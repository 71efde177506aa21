"""Rao–Blackwellised particle filter for rare slugs: a particle is a sequence of regimes, quiet or
slug, with an extended Kalman filter; `switching_inflow_filter` mixes the regimes at each step.
"""

import numpy as np

from eitbench import Task
from eitbench.estimation import InflowEstimator, ParticleInflowFilter, linearise_at_prediction

LEVEL_STD = 0.05
"""Standard deviation of the inflow between slugs, relative to the best homogeneous estimate."""
PARTICLES = 8
"""Number of particles; each branches into two regimes, so that 16 filters run."""
SEED = 0


class Estimator(InflowEstimator):
    subtracks = ("filter",)
    parameters = {"level_std": LEVEL_STD, "particles": PARTICLES, "seed": SEED}  # noqa: RUF012

    def start(self, c_ref: float) -> ParticleInflowFilter:
        return ParticleInflowFilter(
            self.task, self.prior, c_ref, LEVEL_STD, linearise_at_prediction(self.task), PARTICLES,
            np.random.default_rng(SEED))

    @classmethod
    def suits(cls, task: Task) -> bool:
        return super().suits(task) and cls.priors(task)[0].regimes is not None
