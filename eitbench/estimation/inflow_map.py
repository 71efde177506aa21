"""The most probable history of the inflow, by Gauss–Newton (``docs/methods.md``, 10)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular, toeplitz

from eitbench.estimation.identified import IdentifiedModel
from eitbench.estimation.inflow_history import InflowFilter
from eitbench.estimation.inflow_prior import InflowPrior
from eitbench.estimation.inflow_response import Response
from eitbench.worlds.task import Task

SETTLED = 1e-3
"""Largest change of an inflow, in prior standard deviations, of the last iteration."""
MOST = 12
"""Iterations."""


def smoothed_inflow(task: Task, prior: InflowPrior, level: float,
                    record: Sequence[tuple[np.ndarray, np.ndarray]],
                    responses: Sequence[Response] | None = None,
                    model: IdentifiedModel | None = None) -> InflowFilter:
    """The filter at the end of a record of (voltages, currents), (L,) each: `InflowFilter.state`
    tells all states from there, with everything measured known. ``responses`` and ``model`` as
    there."""
    smoother = InflowFilter(task, prior, level, len(record), responses, model)
    for voltages, currents in record:
        smoother.predict()
        smoother.update(voltages, currents)
    return smoother


def most_probable_inflow(smoother: InflowFilter,
                         record: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
    """Move what `smoothed_inflow` has found of a record to the maximum of the posterior density,
    with the covariance there, linearised at all states anew.

    With x = L z, z ~ N(0, I), it is the least of ‖z‖² + Σ_t ‖A_t (V_t − R(c_t(x)))‖², found by
    Gauss–Newton with halved steps where one leads up. A_t whitens the readings' errors; the noise
    is that of the voltages computed from the smoothed states. ``ValueError`` if the smoother has a
    model with voltages that are linearised once: there is nothing to linearise anew.
    """
    if smoother.model is not None and smoother.model.scatter is not None:
        raise ValueError("smoother must have a model whose voltages are linearised anew, got one "
                         "whose voltages are linearised once")
    whole = _Record(smoother, record)
    z = whole.whitened(smoother.mean)
    value = whole.value(z)
    for _ in range(MOST):
        residual, jacobian = whole.linearise(z)
        factor = cho_factor(np.eye(z.size) + jacobian.T @ jacobian, lower=True)
        change = cho_solve(factor, jacobian.T @ residual - z.ravel()).reshape(z.shape)
        part = 1.0
        while (there := whole.value(z + part * change)) > value and part > 1e-3:
            part *= 0.5
        if there > value:                                            # rounding is all that is left
            break
        z = z + part * change
        value = there
        if np.abs(part * change).max() < SETTLED:
            break
    _, jacobian = whole.linearise(z)
    factor = cho_factor(np.eye(z.size) + jacobian.T @ jacobian, lower=True)
    smoother.mean = whole.root @ z
    root = np.kron(whole.root, np.eye(z.shape[1]))
    half = solve_triangular(factor[0], root.T, lower=True)
    smoother.covariance = half.T @ half


class _Record:
    """A record of T measurements as a function of z (W, r)."""

    def __init__(self, smoother: InflowFilter,
                 record: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
        self.smoother = smoother
        voltages, self.currents = (np.array(part) for part in zip(*record, strict=True))
        entries = smoother.prior.time_covariance(smoother.window)
        self.root = np.linalg.cholesky(toeplitz(entries))
        errors = [self._errors(lag, currents) for lag, currents in self._by_lag()]
        self.voltages = voltages - [mean for mean, _ in errors]
        self.whitener = np.linalg.inv(np.linalg.cholesky([variance for _, variance in errors]))
        """(T, L, L) A_t"""

    def _errors(self, lag: int, currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean (L,) and covariance (L, L) of readings' errors."""
        smoother = self.smoother
        task = smoother.task
        point = smoother.concentration(lag)
        model = smoother.model
        if model is None:
            std = task.noise.std(task.observation.voltages(point, currents[None])[0])
            return np.zeros_like(std), np.diag(std**2)
        computed, by_c = task.observation.linearise(point, currents[None])
        std = task.noise.std(computed[0])
        shared = smoother.level * (by_c[0] @ model.root)
        return model.mean_error(currents, std), np.diag(std**2) + shared @ shared.T

    def _by_lag(self) -> list[tuple[int, np.ndarray]]:
        last = len(self.currents) - 1
        return [(last - t, currents) for t, currents in enumerate(self.currents)]

    def whitened(self, x: np.ndarray) -> np.ndarray:
        return solve_triangular(self.root, x, lower=True)

    def value(self, z: np.ndarray) -> float:
        """What is to be least."""
        smoother = self.smoother
        smoother.mean = self.root @ z
        observation = smoother.task.observation
        computed = [observation.voltages(smoother.concentration(lag), currents[None])[0]
                    for lag, currents in self._by_lag()]
        residual = np.einsum("tij,tj->ti", self.whitener, self.voltages - np.array(computed))
        return float((z**2).sum() + (residual**2).sum())

    def linearise(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Whitened residuals (T·L,), and the derivatives (T·L, W·r) by z of the readings that are
        computed, whitened too."""
        smoother = self.smoother
        smoother.mean = self.root @ z
        W, r = z.shape
        residuals = np.empty(self.voltages.shape)
        jacobian = np.zeros((*self.voltages.shape, W, r))
        for t, (lag, currents) in enumerate(self._by_lag()):
            point = smoother.concentration(lag)
            computed, by_c = smoother.task.observation.linearise(point, currents[None])
            residuals[t] = self.whitener[t] @ (self.voltages[t] - computed[0])
            by_x = self.whitener[t] @ smoother.by_inflow(by_c[0], lag)
            jacobian[t, :, lag:lag + smoother.memory] = by_x.reshape(-1, smoother.memory, r)
        by_z = np.tensordot(jacobian, self.root, (2, 0)).swapaxes(2, 3)
        return residuals.ravel(), by_z.reshape(residuals.size, -1)
