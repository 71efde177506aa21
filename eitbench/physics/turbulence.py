"""Turbulent velocity fluctuations between two walls: random modes of the stream function."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from eitbench.numerics.sparse_lu import SparseLU
from eitbench.physics.transport import (
    MIN_WIDE_COLUMNS,
    ConvectionDiffusion,
    supg_basis,
    upwinding,
    velocity_at,
)

WAVE_NUMBER_RATIO = 10.0
"""Largest wave number of the fluctuations, relative to the smallest [E]."""
RTOL = 3e-4
"""Largest change in the last iteration of a sub-step, relative to the largest concentration."""
DROP = 1e-3
"""Relative size of entries dropped from the factors of the mean flow's operator."""
MAX_SOLVES = 30
"""Maximum number of iterations of a sub-step."""


@dataclass(frozen=True, eq=False)
class RandomEddies:
    """Divergence-free fluctuations that vanish on the walls y = ±R (kinematic simulation).

    The stream function is ψ = (1 − η²)²·Σ a_n cos(k_n·x + θ_n(t)) with η = y/R and dθ_n/dt = ω_n −
    k_n·(v̄, 0): the mean flow convects the modes, which decorrelate by their ω_n; u = (∂ψ/∂y,
    −∂ψ/∂x) (Kraichnan 1970; Fung, Hunt, Malik & Perkins 1992).
    """

    half_width: float
    """R in m"""
    amplitudes: np.ndarray
    """(N,) a_n in m²/s"""
    wave_vectors: np.ndarray
    """(N, 2) k_n in rad/m"""
    rates: np.ndarray
    """(N,) dθ_n/dt in rad/s"""
    phases: np.ndarray
    """(N,) θ_n(0)"""

    @classmethod
    def draw(cls, random: np.random.Generator, half_width: float, mean_velocity: float,
             intensity: float, integral_scale: float, n_modes: int) -> RandomEddies:
        """Draw modes with random directions, phases and frequencies and E(k) ∝ k^(−5/3).

        The rms of a velocity component over the channel is ``intensity`` times ``mean_velocity`` in
        m/s, averaged over phases. The longitudinal integral scale in m of isotropic modes, without
        the wall factor, is Σ E_n 2/k_n / Σ E_n. ω_n is Gaussian, its standard deviation the
        rate of the eddies' turnover, u' k_1^(1/3) k_n^(2/3).
        """
        k = np.geomspace(1.0, WAVE_NUMBER_RATIO, n_modes)
        energy = k**(-2 / 3)                                    # E(k) dk with dk ∝ k
        k *= (energy * 2.0 / k).sum() / energy.sum() / integral_scale
        rms = intensity * mean_velocity
        amplitudes = np.sqrt(energy) / k
        # channel averages of (1 − η²)⁴, and of the squared derivative of (1 − η²)² by y
        mean_square = 0.5 * amplitudes**2 @ (128 / 315 * k**2 + 128 / 105 / half_width**2)
        angle = random.uniform(0.0, 2.0 * np.pi, n_modes)
        vectors = k[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        turnover = rms * k[0]**(1 / 3) * k**(2 / 3) * random.standard_normal(n_modes)
        return cls(half_width, amplitudes * rms * np.sqrt(2.0 / mean_square), vectors,
                   turnover - mean_velocity * vectors[:, 0],
                   random.uniform(0.0, 2.0 * np.pi, n_modes))

    def modes(self, points: np.ndarray) -> np.ndarray:
        """Return ψ of cosine and sine modes at points (k, 2) in m, (k, 2N) in m²/s."""
        angle = points @ self.wave_vectors.T
        wall = (1.0 - (points[:, 1:] / self.half_width)**2)**2
        return wall * np.hstack([self.amplitudes * np.cos(angle), -self.amplitudes * np.sin(angle)])

    def coefficients(self, times: np.ndarray) -> np.ndarray:
        """Return the coefficients (2N, T) of `modes` at times (T,) in s."""
        angle = self.phases[:, None] + np.outer(self.rates, times)
        return np.concatenate([np.cos(angle), np.sin(angle)])

    def velocity(self, points: np.ndarray, time: float) -> np.ndarray:
        """Return the fluctuation (k, 2) in m/s at points (k, 2) in m."""
        angle = points @ self.wave_vectors.T + self.phases + self.rates * time
        eta = points[:, 1] / self.half_width
        wall = (1.0 - eta**2)**2
        slope = -4.0 * eta * (1.0 - eta**2) / self.half_width
        sines = (self.amplitudes * np.sin(angle)) @ self.wave_vectors
        along = slope * (np.cos(angle) @ self.amplitudes) - wall * sines[:, 1]
        return np.stack([along, wall * sines[:, 0]], axis=1)


class FluctuatingTransport(ConvectionDiffusion):
    """Convection-diffusion in a mean flow with fluctuations, 2D, from one time on.

    Each sub-step of `ConvectionDiffusion` has the velocity at its middle. Its equations are solved
    by iteration with incomplete factors of the mean flow's operator. The stream function ψ is
    linear in each cell: the discrete fluctuation has no divergence, does not cross walls, where
    ψ = 0, and conserves solute. Test functions have the mean flow's upwinding.

    Parameters
    ----------
    mean : ConvectionDiffusion
        Transport in the mean flow.
    eddies : RandomEddies
    """

    def __init__(self, mean: ConvectionDiffusion, eddies: RandomEddies) -> None:
        super().__init__(mean.mesh, mean.velocity, mean.diffusivity, mean.time_step,
                         substeps=mean.substeps, inlet=mean.inlet)
        self.begin = 0.0
        self._eddies = eddies
        self._modes = eddies.modes(self.mesh.points)
        basis = supg_basis(self.mesh)
        v = velocity_at(self.velocity, np.asarray(basis.global_coordinates()))
        tau, _ = upwinding(basis, v, self.diffusivity)
        slopes = np.array([phi[0].grad[..., 0] for phi in basis.basis])           # (3, 2, cells)
        loads = np.array([((phi[0] + tau * (v * phi[0].grad).sum(axis=0)) * basis.dx).sum(axis=1)
                          for phi in basis.basis])            # of test functions, (3, cells)
        rows = np.arange(2 * basis.nelems).reshape(1, 2, -1)
        cells, nodes = (np.broadcast_to(each, slopes.shape).ravel()
                        for each in (rows, basis.element_dofs[:, None]))
        self._gradient = sp.csr_matrix((slopes.ravel(), (cells, nodes)))
        tested = np.broadcast_to(loads[:, None], slopes.shape).ravel()
        self._tested = sp.csr_matrix((tested, (nodes, cells)))[self._free]
        self._implicit = 2.0 * self.substeps / self.time_step * self._mass - self._explicit
        self._approximate = SparseLU(self._implicit[:, self._free], DROP)

    def stream_function(self, times: np.ndarray) -> np.ndarray:
        """Return the stream function (n, T) of the fluctuations in m²/s at times (T,) in s."""
        return self._modes @ self._eddies.coefficients(times)

    def at(self, begin: float) -> FluctuatingTransport:
        """Return the transport of the step that begins at this time in s."""
        step = copy.copy(self)
        for cached in ("_transition", "_evolution_model"):
            vars(step).pop(cached, None)
        step.begin = begin
        return step

    def _advance(self, c: np.ndarray, before: np.ndarray, after: np.ndarray,
                 source: np.ndarray | None = None) -> np.ndarray:
        if c.shape[1] == 1:                    # products with one-dimensional arrays are faster
            c, before, after = c[:, 0], before[:, 0], after[:, 0]
        dt = self.time_step / self.substeps
        slope = (after - before) / self.substeps
        load = 0.0 if source is None else self._mass @ source
        # backward Euler to the ends of two half sub-steps; then Crank–Nicolson about the middles
        times = dt * np.concatenate([[0.5, 1.0], np.arange(1.5, self.substeps)])
        by_x, by_y = np.split(self._gradient @ self.stream_function(self.begin + times), 2)
        velocity = np.concatenate([by_y, -by_x]).T.copy()                  # (solves, 2 cells)
        c = c.copy()
        c[self.inlet] = before
        change = np.zeros_like(c)
        for k, v in enumerate(velocity):
            halved = k < 2
            right = (self._mass @ c / dt if halved else self._explicit @ c) \
                + (0.5 if halved else 1.0) * load
            new = c + (2.0 if k == 2 else 1.0) * change                    # twice as long
            new[self.inlet] = before + (k or 0.5) * slope
            solve = self._iterate if c.ndim == 1 or c.shape[1] < MIN_WIDE_COLUMNS else self._factor
            solve(right, v, new, 0.0 * c if halved else c)
            change = new - c
            c = new
        c[self.inlet] = after
        return c.reshape(len(c), -1)

    def _iterate(self, right: np.ndarray, v: np.ndarray, new: np.ndarray, old: np.ndarray) -> None:
        """Solve A x + N(v) (x + ``old``)/2 = ``right`` for the free nodes of x = ``new``."""
        for _ in range(MAX_SOLVES):
            advected = self._tested @ (v * (self._gradient @ (new + old)).T).T
            residual = right - self._implicit @ new - 0.5 * advected
            correction = self._approximate.solve(residual.reshape(len(residual), -1))
            new[self._free] += correction.reshape(residual.shape)
            if np.abs(correction).max() <= RTOL * np.abs(new).max():
                return
        raise ArithmeticError("fluctuations must be weaker or sub-steps shorter: the advection "
                              f"does not converge in {MAX_SOLVES} iterations")

    def _factor(self, right: np.ndarray, v: np.ndarray, new: np.ndarray, old: np.ndarray) -> None:
        """Solve the same by a factorisation, which is faster for many columns."""
        advection = 0.5 * (self._tested @ sp.diags_array(v) @ self._gradient)
        full = sp.csr_array(self._implicit + advection)
        load = right - advection @ old - full[:, self.inlet] @ new[self.inlet]
        new[self._free] = SparseLU(full[:, self._free]).solve(load)
