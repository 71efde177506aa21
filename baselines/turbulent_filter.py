"""Log-inflow filter with unknown eddies: flow and error of the concentration are part of the state.

The velocity is the mean flow and modes of eddies with coefficients b, an autoregression; the
concentration is c(x) + c_ref B z with the inflow window x of the mean flow, whose error z the
eddies change. `studies/turbulence.py` fits modes and noise to training episodes.
"""

from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag
from scipy.sparse.linalg import splu

from eitbench import Task
from eitbench.estimation import (
    DenseCovariance,
    Filter,
    InflowEstimator,
    InflowWindow,
    linearise_at_prediction,
)
from eitbench.estimation.inflow_response import steady_response
from eitbench.numerics.fem import mass_matrix
from eitbench.physics.transport import ConvectionDiffusion, supg_basis

MODEL = Path(__file__).parent / "models" / "turbulent" / "pipe2dturbulent.npz"
NOISE_FACTOR = 2.0
"""Factor of the fitted noise of z, for products of errors, which the covariance omits."""


def eddy_products(transport: ConvectionDiffusion, eddies: np.ndarray,
                  modes: np.ndarray) -> np.ndarray:
    """Return D (p, q, k + q): z changes by Σ_j b_j D_j u in a step, with u the coordinates of the
    concentration in the basis (n, k) of the mean flow's response and in ``modes`` B (n, q).

    ``eddies`` (n, p) are stream functions ψ_j in m²/s. D_j = −τ Bᵀ M F_½ M⁻¹ N_j F_½ (basis, B) is
    the midpoint rule for the derivative of a step τ, with N_j c = ∫φ v_j·∇c, v_j = (∂ψ_j/∂y,
    −∂ψ_j/∂x) and F_½ half a step in the mean flow, which convects eddies and concentration alike.
    """
    mesh = transport.mesh
    half = ConvectionDiffusion(mesh, transport.velocity, transport.diffusivity,
                               0.5 * transport.time_step, substeps=transport.substeps // 2,
                               inlet=transport.inlet)
    F, _ = half.transition()
    columns = np.hstack([steady_response(transport).basis, modes])
    entering = columns[transport.inlet]
    M = mass_matrix(mesh).tocsc()
    cells = supg_basis(mesh)
    nodes = cells.element_dofs                                              # (3, cells)
    slopes = np.array([phi[0].grad[..., 0] for phi in cells.basis])         # (3, 2, cells)
    after = splu(M).solve(F.T @ (M @ modes))
    loads = after[nodes].sum(axis=0).T * cells.dx.sum(axis=1) / 3.0         # (q, cells)
    by_x, by_y = np.einsum("idc,ick->dck", slopes, half.step(columns, entering, entering)[nodes])
    psi_x, psi_y = np.einsum("idc,icp->dpc", slopes, eddies[nodes])
    return -transport.time_step * np.array([
        loads @ (v[:, None] * by_x - w[:, None] * by_y) for v, w in zip(psi_y, psi_x, strict=True)])


@lru_cache(maxsize=1)
def fitted_model(transport: ConvectionDiffusion) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the arrays that `studies/turbulence.py` writes, and `eddy_products`."""
    with np.load(MODEL) as file:
        arrays = {name: file[name].astype(float) for name in file}
    return arrays, eddy_products(transport, arrays["eddies"], arrays["modes"])


class EddyWindow(InflowWindow):
    """Inflow window x, error z (q,) and coefficients b (p,): c = c(x) + c_ref B z,
    z⁺ = A z + Σ_j b_j⁺ D_j u(x, z) + w, b⁺ = A_b b + w_b."""

    def __init__(self, task: Task, prior, c_ref: float) -> None:
        super().__init__(task, prior, c_ref)
        self.model, self.products = fitted_model(task.transport)
        self.modes = self.model["modes"]
        weights, variances = self.ar_model
        self.n = weights.size
        self.errors = slice(self.n, self.n + self.modes.shape[1])
        self.shift = np.eye(self.n, k=-weights.shape[1])
        self.shift[:weights.shape[1]] = np.hstack([np.diag(each) for each in weights])
        self.noise = np.diag(np.pad(variances, (0, self.n - len(variances))))

    def initial(self):
        covariance = block_diag(super().initial()[1].array, self.model["initial"],
                                self.model["eddy_initial"])
        return np.zeros(len(covariance)), DenseCovariance(covariance)

    def propagate(self, mean, covariance, time: int):
        end, A, A_b = self.errors.stop, self.model["transition"], self.model["eddy_transition"]
        x, z, b = np.split(mean, [self.n, end])
        P, b = covariance.array, A_b @ b
        basis = self.response().basis                                       # orthonormal
        y = basis.T @ (super().concentration(x) / self.c_ref - 1.0)
        u_by_state = block_diag(super().jacobian(x, basis.T) / self.c_ref, np.eye(len(z)))
        z_by_b = (self.products @ np.concatenate([y, z])).T
        by_b = np.vstack([np.zeros((self.n, len(b))), z_by_b, np.eye(len(b))])
        F = np.hstack([block_diag(self.shift, A, np.zeros((len(b), 0))), by_b @ A_b])
        F[self.errors, :end] += np.tensordot(b, self.products, 1) @ u_by_state
        noise = block_diag(self.noise, NOISE_FACTOR * self.model["noise"], np.zeros(A_b.shape))
        noise += by_b @ self.model["eddy_noise"] @ by_b.T
        # the mean of a product of two unknowns includes their covariance
        together = u_by_state @ P[:end, end:] @ A_b.T
        z = A @ z + z_by_b @ b + np.einsum("jqu,uj->q", self.products, together, optimize=True)
        return np.concatenate([self.shift @ x, z, b]), DenseCovariance(F @ P @ F.T + noise)

    def concentration(self, mean, lag: int = 0):
        return super().concentration(mean[:self.n]) + self.c_ref * (self.modes @ mean[self.errors])

    def jacobian(self, mean, matrix, lag: int = 0):
        return np.hstack([super().jacobian(mean[:self.n], matrix),
                          self.c_ref * (matrix @ self.modes)])

    def variance(self, mean, covariance, lag: int = 0):
        basis = self.response().basis                                       # orthonormal
        slope = block_diag(super().jacobian(mean[:self.n], basis.T),
                           self.c_ref * np.eye(self.modes.shape[1]))
        both, k = np.hstack([basis, self.modes]), slope.shape[1]
        return (both @ (slope @ covariance.array[:k, :k] @ slope.T) * both).sum(axis=1)


class Estimator(InflowEstimator):
    subtracks = ("filter",)

    def start(self, c_ref: float) -> Filter:
        return Filter(EddyWindow(self.task, self.prior, c_ref),
                      linearise_at_prediction(self.task))

    @classmethod
    def suits(cls, task: Task) -> bool:
        """Return True in the world whose errors were fitted."""
        return task.world == "Pipe2DTurbulent" and not task.lag
