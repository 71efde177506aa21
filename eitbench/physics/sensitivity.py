"""Sensitivity of voltages to nodal conductivities: −∫ φ_j ∇w_m·∇w_l for all pairs of fields."""

from __future__ import annotations

import numpy as np
import skfem

from eitbench.numerics.compiled import aligned_zeros, compiled_kernels, scratch


class Sensitivity:
    """Integrals of products of gradients with the hat functions of a mesh.

    They are exact: the gradient of a potential of first or second order is linear on a simplex and
    determined by its values at the vertices. With w = |T|/((d+1)(d+2)(d+3)),
    ∫ λ_j λ_v λ_v' = w (1 + [j=v] + [j=v'] + [v=v'] + 2[j=v=v']). With the gradient G_v at vertex v
    and S = Σ_v G_v,
    ∫ φ_j ∇w_m·∇w_l = w ((S + G_j)_m·(S + G_j)_l + Σ_v G_vm·G_vl + G_jm·G_jl).

    Parameters
    ----------
    basis : skfem.CellBasis
        Basis of the potential.
    """

    def __init__(self, basis: skfem.CellBasis) -> None:
        dim = basis.mesh.dim()
        self._cells = np.ascontiguousarray(basis.mesh.t.T.astype(np.int64))
        self._unknowns = np.ascontiguousarray(basis.element_dofs.T.astype(np.int64))
        corners = np.hstack([np.zeros((dim, 1)), np.eye(dim)])
        at_corners = skfem.Basis(basis.mesh, basis.elem,
                                 quadrature=(corners, np.full(dim + 1, 1.0 / (dim + 1))))
        gradient = np.stack([phi[0].grad.transpose(1, 2, 0) for phi in at_corners.basis], axis=-1)
        gradient = gradient.reshape(basis.mesh.nelements, -1, gradient.shape[-1])
        weight = basis.dx.sum(axis=1) / ((dim + 1) * (dim + 2) * (dim + 3))
        # (cells, vertices·dim, unknowns per cell), times √w
        self._gradient = np.sqrt(weight)[:, None, None] * gradient

    def __call__(self, fields: np.ndarray, mixtures: np.ndarray | None = None) -> np.ndarray:
        """Return −∫ φ_j ∇v_i·∇w_l (n_nodes, m, k) for potentials w (n_potential, k), and their
        combinations v with weights ``mixtures`` (m, k); by default v is w."""
        k = fields.shape[1]
        width = -(-k // 8) * 8
        padded = aligned_zeros((len(fields), width))
        padded[:, :k] = fields
        weights = np.zeros((0 if mixtures is None else len(mixtures), width))
        weights[:, :k] = 0.0 if mixtures is None else mixtures
        table = aligned_zeros((self._cells.max() + 1, len(weights) or width, width))
        rows = 2 * self._gradient.shape[1]
        memory = scratch(rows * (width + len(weights)))
        compiled_kernels().subtract_gradient_products(
            self._cells, self._unknowns, self._gradient, padded, weights, table,
            memory[:rows * width], memory[rows * width:])
        return table[:, :len(weights) or k, :k]
