"""Gauss–Newton method, reconstruction of a stationary target (thesis 5.11), and best homogeneous
estimate."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.linalg import cho_factor, cho_solve, lu_factor, lu_solve

from eitbench.estimation.nodal import initial_covariance
from eitbench.numerics.mesh import Mesh
from eitbench.numerics.sparse_lu import SparseLU
from eitbench.physics.observation import ObservationModel, VoltageModel, VoltageNoise
from eitbench.worlds.task import Estimate, Task


def gauss_newton(model: VoltageModel, voltages: np.ndarray, currents: np.ndarray,
                 noise_std: np.ndarray, penalty: Any, start: np.ndarray, *,
                 tolerance: float = 1e-3, step_tolerance: float = 0.0,
                 max_iterations: int = 20) -> np.ndarray:
    """Return argmin_c ‖(V − U(c))/std‖² + cᵀ penalty c (n,), by Gauss–Newton with step halving.

    If ``max_iterations`` are reached or no step lowers the objective, it is the last iterate.

    Parameters
    ----------
    model : VoltageModel
    voltages, currents, noise_std : (K, L)
        One frame: measurements in V, NaN where missing, injections in A (A/m in 2D), standard
        deviations in V.
    penalty : (n, n) sparse or dense
        Inverse covariance of the prior, or α² times the stiffness matrix for α²∫|∇c|².
    start : (n,)
        Initial guess in the unit of c, mol/m³ or the unit of the model's argument.
    tolerance : float
        A step with a smaller predicted relative decrease of the objective is the last one.
    step_tolerance : float
        A step that changes all entries of c by less, in the unit of c, is the last one.
    """
    normal = _NormalEquations(penalty)
    missing = np.isnan(voltages)
    weight = np.where(missing, 0.0, 1.0 / noise_std).ravel()
    voltages = np.nan_to_num(voltages)
    c = np.array(start, dtype=float)

    def misfit(c: np.ndarray, computed: np.ndarray) -> float:
        return float((((voltages - computed).ravel() * weight)**2).sum() + c @ (penalty @ c))

    computed, jacobian = model.linearise(c, currents)
    for iteration in range(max_iterations):
        A = jacobian.reshape(-1, len(c)) * weight[:, None]
        residual = (voltages - computed).ravel() * weight
        gradient = A.T @ residual - penalty @ c
        direction = normal.solve(A, gradient)
        now = misfit(c, computed)
        last = (gradient @ direction < tolerance * now or np.abs(direction).max() < step_tolerance
                or iteration == max_iterations - 1)
        length = 1.0
        while True:
            trial = c + length * direction
            if last:
                computed = model.voltages(trial, currents)
            else:       # one factorisation gives the voltages and the derivatives for the next step
                computed, jacobian = model.linearise(trial, currents)
            if misfit(trial, computed) <= now:
                break
            length *= 0.5
            if length < 1e-4:
                return c
        c = trial
        if last:
            break
    return c


def one_step(model: VoltageModel, voltages: np.ndarray, currents: np.ndarray,
             noise_std: np.ndarray, strength: float, power: float,
             start: np.ndarray) -> np.ndarray:
    """Return a linear difference image: start + argmin_x ‖(V − U(start) − J x)/std‖² + xᵀ Γ⁻¹ x.

    Arguments as in `gauss_newton`. With A = J/std of the measured voltages the prior is
    Γ = diag(AᵀA)^-power / strength²: power 1 is NOSER (Cheney et al. 1990), 0 Tikhonov, 1/2 a usual
    compromise (EIDORS). Nodes of less than a millionth of the largest sensitivity have that
    variance.
    """
    computed, jacobian = model.linearise(start, currents)
    measured = np.isfinite(voltages)
    weight = 1.0 / noise_std[measured]
    A = jacobian[measured] * weight[:, None]
    squares = (A**2).sum(axis=0)
    inverse = strength**2 * np.maximum(squares, 1e-6 * squares.max())**power
    residual = (voltages - computed)[measured] * weight
    return start + _NormalEquations(sp.diags_array(inverse)).solve(A, A.T @ residual)


def nearest_observed(task: Task) -> np.ndarray:
    """Return for each node the number of the nearest node on which voltages depend, (n,). They do
    not depend on all nodes if the electrode mesh is coarser than the transport mesh."""
    # lazy import: other estimators do not need it
    from scipy.spatial import cKDTree
    weights = abs(task.observation.interpolation).max(axis=0).toarray().ravel()
    observed = np.flatnonzero(weights > 1e-9)    # less is rounding
    return observed[cKDTree(task.mesh.points[observed]).query(task.mesh.points)[1]]


def total_variation(model: VoltageModel, voltages: np.ndarray, currents: np.ndarray,
                    noise_std: np.ndarray, mesh: Mesh, alpha: float, smoothing: float,
                    start: np.ndarray, n_iterations: int = 10) -> np.ndarray:
    """Return argmin_c ‖(V − U(c))/std‖² + 2 α ∫√(|∇c|² + β²), by lagged diffusivity (Vogel & Oman
    1996): each iteration is a Gauss–Newton step with the penalty of the last image.

    Arguments as in `gauss_newton`; ``alpha`` is in m^(1-d)/(mol/m³), ``smoothing`` β in mol/m⁴.
    """
    # lazy import: other estimators do not need finite elements
    from eitbench.numerics.fem import diffusivity_matrix
    c = start
    for _ in range(n_iterations):
        penalty = alpha * diffusivity_matrix(mesh, c, smoothing)
        before, c = c, gauss_newton(model, voltages, currents, noise_std, penalty, c,
                                    max_iterations=1)
        if np.abs(c - before).max() < 1e-3 * np.abs(c).max():
            break
    return c


class StationaryMap:
    """Maximum a posteriori estimate of a stationary target from all measurements so far, for
    `FilterEstimator`.

    A function u of the relative concentration c/ĉ_bh has the prior N(0, Γ_{0|0}), with the initial
    covariance of the Kalman filter. ``relative`` maps u (n,) to c/ĉ_bh and its derivative by u,
    node by node, and ``c_ref`` is ĉ_bh in mol/m³. Gauss–Newton starts from the previous estimate.
    """

    def __init__(self, task: Task, c_ref: float,
                 relative: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]) -> None:
        self.task = task
        self.c_ref = c_ref
        self.relative = relative
        self._penalty = np.linalg.inv(initial_covariance(task.mesh, task.prior))
        self._u = np.zeros(task.mesh.n_nodes)
        self._record: list[tuple[np.ndarray, np.ndarray]] = []

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> None:
        """Store a measurement vector (L,) in V and its injection (L,) in A (A/m in 2D)."""
        self._record.append((voltages, currents))

    def estimate(self, lag: int = 0) -> Estimate:
        """Return the estimate (n,) in mol/m³ from all measurements so far; ``lag`` is ignored."""
        V, I = (np.array(part) for part in zip(*self._record, strict=True))
        self._u = gauss_newton(self, V, I, self.task.noise.std(V), self._penalty, self._u)
        return Estimate(self.c_ref * self.relative(self._u)[0])

    def voltages(self, u: np.ndarray, currents: np.ndarray) -> np.ndarray:
        """Return voltages (K, L) in V; with `linearise` this is a `VoltageModel` of u."""
        return self.task.observation.voltages(self.c_ref * self.relative(u)[0], currents)

    def linearise(self, u: np.ndarray, currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return voltages (K, L) in V, and their derivatives (K, L, n) by u in V."""
        relative, derivative = self.relative(u)
        voltages, by_c = self.task.observation.linearise(self.c_ref * relative, currents)
        return voltages, by_c * (self.c_ref * derivative)


class _NormalEquations:
    """Solver of (AᵀA + P) x = g for one P (n, n), positive semidefinite, and any A (m, n).

    For sparse P and A with far fewer rows than columns, x = P₀⁻¹g − W (C + V W)⁻¹ Wᵀg with
    P₀ = P + ρ e eᵀ, V = (A; √ρ eᵀ), C = diag(1, …, 1, −1) and W = P₀⁻¹Vᵀ (Woodbury). The unit
    vector e of the first node makes P₀ regular for gradient penalties, whose null space holds the
    constants. If P₀ is singular or the residual is too large, and in all other cases, AᵀA + P is
    factorised.
    """

    def __init__(self, penalty: Any) -> None:
        self._penalty = penalty
        self._grounded = None
        if sp.issparse(penalty):
            self._ground = float(penalty.diagonal().max())                             # ρ
            held = sp.csr_array(([self._ground], ([0], [0])), shape=penalty.shape)
            with suppress(RuntimeError):                                  # P₀ is singular
                self._grounded = SparseLU(penalty + held)

    def solve(self, A: np.ndarray, g: np.ndarray) -> np.ndarray:
        """Return x (n,) for g (n,)."""
        if 3 * len(A) < len(g) and self._grounded is not None:
            apply = self._by_woodbury(A, self._grounded)
            x = apply(g)
            x += apply(self._residual(A, g, x))              # refinement, because of cancellation
            if np.linalg.norm(self._residual(A, g, x)) <= 1e-10 * np.linalg.norm(g):
                return x
        return cho_solve(cho_factor(np.asarray(A.T @ A + self._penalty)), g)

    def _residual(self, A: np.ndarray, g: np.ndarray, x: np.ndarray) -> np.ndarray:
        return g - A.T @ (A @ x) - self._penalty @ x

    def _by_woodbury(self, A: np.ndarray, grounded: SparseLU) -> Callable[[np.ndarray], np.ndarray]:
        held = np.zeros((1, A.shape[1]))
        held[0, 0] = np.sqrt(self._ground)
        V = np.concatenate([A, held])
        W = grounded.solve(V.T)
        core = lu_factor(V @ W + np.diag(np.append(np.ones(len(A)), -1.0)))
        return lambda g: grounded.solve(g[:, None])[:, 0] - W @ lu_solve(core, W.T @ g)


def best_homogeneous(model: ObservationModel, noise: VoltageNoise, voltages: np.ndarray,
                     currents: np.ndarray, start: float, *, tolerance: float = 1e-8,
                     max_iterations: int = 30) -> float:
    """Return ĉ_bh = argmin_c Σ ((V − U(c·1))/std)², by Gauss–Newton in ln c (docs/methods.md, 3).

    Steps in ln c keep c positive. ``RuntimeError`` if the iteration does not converge.

    Parameters
    ----------
    model : ObservationModel
    noise
        Noise model with a method ``std(voltages)``, evaluated at the measured voltages.
    voltages, currents : (K, L)
        Measurements in V, NaN where missing, and injections in A (A/m in 2D).
    start : float
        Initial guess in mol/m³, > 0.
    """
    # Injections repeat: U(c·1) is computed once for each distinct pattern.
    patterns, which = np.unique(currents, axis=0, return_inverse=True)
    which = which.reshape(-1)
    weight = np.isfinite(voltages) / noise.std(np.nan_to_num(voltages))
    voltages = np.nan_to_num(voltages)
    c = float(start)
    for _ in range(max_iterations):
        computed, by_log = model.homogeneous(c, patterns)
        residual = (voltages - computed[which]) * weight
        slope = by_log[which] * weight
        change = float(np.clip((slope * residual).sum() / (slope**2).sum(), -1.0, 1.0))
        c *= float(np.exp(change))
        if abs(change) < tolerance:
            return c
    raise RuntimeError(f"best homogeneous estimate did not converge in {max_iterations} "
                       f"iterations; last change {change:g}, last value {c:g} mol/m³")
