"""The filter of the inflow's history in many episodes at once (``docs/methods.md``, 16)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from eitbench import _check
from eitbench.estimation.inflow_response import Response, steady_response
from eitbench.estimation.moving_window import Innovation, stationary

if TYPE_CHECKING:
    from eitbench.estimation.inflow_prior import InflowPrior
    from eitbench.worlds.task import Task


class InflowBatch:
    """`InflowFilter` in B episodes side by side, each with a mean and a covariance of its own: what
    it gives is what that gives episode by episode.

    The inflow of step t is in slot t mod W of the window, so that nothing is moved when a new one
    takes the place of the oldest; products with what all episodes share are made for all of them
    together.

    Parameters
    ----------
    task : Task
        With `QuadraticVoltages` or `ScaledVoltages` as ``observation``, most of the time goes into
        covariances.
    prior : InflowPrior
        Of the task's inlet; ``ValueError`` if it is not. The time of a step goes with the square of
        its modes.
    levels : (B,)
        ĉ_bh of each episode in mol/m³.
    lag : int
        The oldest state that is asked for, in steps before the present one.
    response : Response, optional
        Of all states; default: that of the task's flow. See `reduced_response`.
    """

    def __init__(self, task: Task, prior: InflowPrior, levels: np.ndarray, lag: int = 0,
                 response: Response | None = None) -> None:
        prior.check_task(task)
        self.task = task
        self.prior = prior
        self.levels = _check.array("levels", levels, (None,), units="mol/m³")
        self.lag = _check.integer("lag", lag, low=0)
        self.response = response or steady_response(task.transport)
        q, self.memory, _ = self.response.weights.shape
        self._by_inflow = self.response.weights.reshape(q, -1)
        B = len(self.levels)
        r = prior.modes.shape[1]
        self.window = W = self.memory + lag
        before, self._regression = stationary(prior.time_covariance(W + 1))
        self._newest = 0
        """slot of x_t"""
        self._mean = np.zeros((B, W, r))
        self._covariance = np.tile(np.kron(before[_aged(W, 0)][:, _aged(W, 0)], np.eye(r)),
                                   (B, 1, 1))
        self._less = np.empty(self._covariance.shape[1:])

    @property
    def mean(self) -> np.ndarray:
        """(B, W, r) of x, the newest first."""
        return self._mean[:, self._slots()]

    @property
    def covariance(self) -> np.ndarray:
        """(B, W·r, W·r), the newest first."""
        r = self._mean.shape[2]
        order = (self._slots()[:, None] * r + np.arange(r)).ravel()
        return self._covariance[:, order[:, None], order]

    def predict(self) -> None:
        """Move one time step on: a new inflow is expected, the oldest is forgotten."""
        B, W, r = self._mean.shape
        weights, variance = self._regression
        by_slot = weights[_aged(W, self._newest)]
        cross = by_slot @ self._covariance.reshape(B, W, -1)
        cross = cross.reshape(B, r, W * r)
        own = (by_slot[:, None] * cross.reshape(B, r, W, r)).sum(axis=2)
        mean = by_slot @ self._mean
        self._newest = (self._newest + 1) % W
        here = slice(self._newest * r, (self._newest + 1) * r)
        self._mean[:, self._newest] = mean
        self._covariance[:, here] = cross
        self._covariance[:, :, here] = cross.swapaxes(1, 2)
        self._covariance[:, here, here] = 0.5 * (own + own.swapaxes(1, 2)) + variance * np.eye(r)

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Innovation:
        """Take in a measurement of the present states, (B, L) in V, for one injection (L,) in A;
        returns (B, L) and (B, L, L)."""
        c = self.concentration()
        voltages = _check.array("voltages", voltages, (len(c), None), units="V")
        found = [self.task.observation.linearise(each, currents[None]) for each in c]
        computed = np.array([each[0][0] for each in found])
        by_c = np.array([each[1][0] for each in found])
        slope = self._by_slot(by_c @ self.response.basis)
        innovation = voltages - computed
        cross = slope @ self._covariance                                         # (B, L, W·r)
        S = cross @ slope.swapaxes(1, 2)
        S = 0.5 * (S + S.swapaxes(1, 2))
        L = np.arange(S.shape[1])
        S[:, L, L] += self.task.noise.std(computed)**2
        factor = np.linalg.cholesky(S)
        gained = np.linalg.solve(factor, cross)                                  # L⁻¹ H Γ
        white = np.linalg.solve(factor, innovation[..., None])
        self._mean += (gained.swapaxes(1, 2) @ white).reshape(self._mean.shape)
        for covariance, each in zip(self._covariance, gained, strict=True):
            covariance -= np.matmul(each.T, each, out=self._less)
        return Innovation(innovation, S)

    def modes(self, lag: int = 0) -> np.ndarray:
        """(B, q) c/ĉ_bh − 1 in the response's basis, ``lag`` steps ago, of the expected inflows."""
        deviation = self.prior.inflow(self._recent(lag)) - 1.0
        return deviation.reshape(len(deviation), -1) @ self._by_inflow.T

    def concentration(self, lag: int = 0) -> np.ndarray:
        """(B, n) mol/m³, ``lag`` steps ago, of the expected inflows."""
        return self.levels[:, None] * (1.0 + self.modes(lag) @ self.response.basis.T)

    def variance(self, lag: int = 0) -> np.ndarray:
        """(B, n) (mol/m³)², of what is known ``lag`` steps ago."""
        basis = self.response.basis
        one = np.eye(basis.shape[1])
        slope = self._by_slot(np.broadcast_to(one, (len(self.levels), *one.shape)), lag)
        reduced = slope @ self._covariance @ slope.swapaxes(1, 2)
        return ((basis @ reduced) * basis).sum(axis=2)

    def _slots(self) -> np.ndarray:
        """(W,) of the newest, the one before, and so on."""
        return (self._newest - np.arange(self.window)) % self.window

    def _recent(self, lag: int) -> np.ndarray:
        """(B, K, n_inlet) u, ``lag`` steps ago and before."""
        return self._mean[:, self._slots()[lag:lag + self.memory]] @ self.prior.modes.T

    def _by_slot(self, by_mode: np.ndarray, lag: int = 0) -> np.ndarray:
        """(B, m, W·r) derivatives by x, in slots, of what has these (B, m, q) by c in the basis,
        ``lag`` steps ago."""
        slots = self._slots()[lag:lag + self.memory]
        slope = self.levels[:, None, None] * self.prior.slope(self._recent(lag))
        B, m, _ = by_mode.shape
        by_u = (by_mode @ self._by_inflow).reshape(B, m, *slope.shape[1:]) * slope[:, None]
        found = np.zeros((B, m, *self._mean.shape[1:]))
        found[:, :, slots] = by_u @ self.prior.modes
        return found.reshape(B, m, -1)


def _aged(window: int, newest: int) -> np.ndarray:
    """(W,) of how many steps ago the inflow in each slot is."""
    return (newest - np.arange(window)) % window
