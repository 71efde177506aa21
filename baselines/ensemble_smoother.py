"""Ensemble smoother with multiple data assimilation (ES-MDA): an ensemble of inflows, conditioned
on all measurements several times (Emerick & Reynolds, Comput. Geosci. 55, 2013).

The inflow's logarithm has the coloured prior of `inflow_smoother`. Each of PASSES passes computes
the voltages of every member without linearisation and inflates the noise variance by PASSES. An
inflow is conditioned only on the measurements of its fluid: this limits sampling errors.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import toeplitz

from eitbench import Estimate, Task
from eitbench.estimation import InflowEstimator, InflowPrior, InflowWindow, RecordSmoother

MEMBERS = 256
PASSES = 4
SEED = 0
"""Random seed of the ensemble, the same in every episode."""


class Estimator(InflowEstimator):
    subtracks = ("smoothing",)
    parameters = {"members": MEMBERS, "passes": PASSES, "seed": SEED}  # noqa: RUF012

    def start(self, c_ref: float) -> RecordSmoother:
        return RecordSmoother(lambda record: smooth(self.task, self.prior, c_ref, record))

    @classmethod
    def suits(cls, task: Task) -> bool:
        # a 3D inlet has too many modes for an ensemble of this size
        return task.mesh.dim == 2 and super().suits(task)


class SmoothedEnsemble:
    """States of a measurement sequence: inflows x (W, N, r) of the members, the newest first."""

    def __init__(self, space: InflowWindow, x: np.ndarray) -> None:
        self.space = space
        self.x = x

    def members(self, lag: int) -> np.ndarray:
        """Return the concentrations (N, n) in mol/m³ ``lag`` steps before the last."""
        return self.space.concentration(self.x.swapaxes(0, 1).reshape(MEMBERS, -1), lag)

    def estimate(self, lag: int) -> Estimate:
        c = self.members(lag)
        return Estimate(c.mean(axis=0), c.var(axis=0, ddof=1))

    def covariance_of(self, functionals: np.ndarray, lag: int) -> np.ndarray:
        return np.atleast_2d(np.cov(functionals @ self.members(lag).T))


def smooth(task: Task, prior: InflowPrior, c_ref: float,
           record: Sequence[tuple[np.ndarray, np.ndarray]]) -> SmoothedEnsemble:
    """Return the states of a measurement sequence."""
    random = np.random.default_rng(SEED)
    V, I = (np.array(part) for part in zip(*record, strict=True))
    space = InflowWindow(task, prior, c_ref, len(record))
    before = np.linalg.cholesky(toeplitz(prior.time_covariance(space.window_steps)))
    x = np.tensordot(before, random.standard_normal((len(before), MEMBERS, space.n_modes)), 1)
    states = SmoothedEnsemble(space, x)
    for _ in range(PASSES):
        computed = np.array([
            task.observation.transfer_resistance(states.members(len(I) - t)) @ I[t - 1]
            for t in range(1, len(I) + 1)])                                          # (T, N, L)
        std = task.noise.std(computed.mean(axis=1))[:, None]
        noise = PASSES**0.5 * random.standard_normal(computed.shape)
        residual = np.nan_to_num((V[:, None] - computed) / std + noise)    # NaN: not measured
        S = np.where(np.isnan(V)[:, None], 0.0, computed - computed.mean(axis=1, keepdims=True))
        S /= std * (MEMBERS - 1)**0.5
        for k, newest in enumerate(range(len(record), len(record) - len(x), -1)):
            seen = slice(max(newest - 1, 0), max(newest - 1 + space.response_steps, 0))
            A, d = (array[seen].swapaxes(1, 2).reshape(-1, MEMBERS) for array in (S, residual))
            gain = np.linalg.solve(A.T @ A + PASSES * np.eye(MEMBERS), A.T @ d)      # (N, N)
            deviation = (x[k] - x[k].mean(axis=0)) / (MEMBERS - 1)**0.5
            x[k] += gain.T @ deviation
    return states
