"""Results of the compiled kernels by scipy and numpy alone.

`kernels.py` compares speed and results; the tests compare the kernels with dense algebra.
"""

from __future__ import annotations

from contextlib import contextmanager
from unittest import mock

import numpy as np
import scipy.sparse as sp
import skfem
from scipy.sparse.linalg import SuperLU, splu

from eitbench.physics import cem, transport

SYMMETRIC = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}


class SuperLUCondensation:
    """`eitbench.numerics.condensation.Condensation` by SuperLU, ordered by minimum degree.

    It requires all entries of the pattern, both triangles.
    """

    batch = 1

    def __init__(self, pattern: sp.csc_array, n_ports: int,
                 places: np.ndarray | None = None) -> None:
        del places                                       # the order affects only the speed
        self.n = pattern.shape[0]
        self.n_ports = n_ports
        inner = pattern[:-n_ports, :-n_ports]
        self._place = np.append(_minimum_degree(inner), np.arange(self.n - n_ports, self.n))
        coo = pattern.tocoo()
        permuted = sp.csc_array((np.ones(coo.nnz), (self._place[coo.row], self._place[coo.col])),
                                shape=pattern.shape)
        permuted.sort_indices()
        self._indices = permuted.indices
        self._indptr = permuted.indptr
        order = np.argsort(self._place)
        self.rows = order[permuted.indices]
        self.columns = order[np.repeat(np.arange(self.n), np.diff(permuted.indptr))]
        self._loads = np.eye(self.n, n_ports, -(self.n - n_ports))

    def port_inverse(self, values: np.ndarray) -> np.ndarray:
        """Return the ports' block of K⁻¹: (m, m) for values (k,), (b, m, m) for values (k, b)."""
        if values.ndim == 1:
            return self._factorised(values).solve(self._loads)[-self.n_ports:]
        return np.stack([self.port_inverse(column) for column in values.T])

    def port_columns(self, values: np.ndarray) -> np.ndarray:
        """Return the ports' columns of K⁻¹, (n, m), for values (k,)."""
        return self._factorised(values).solve(self._loads)[self._place]

    def _factorised(self, values: np.ndarray) -> SuperLU:
        matrix = sp.csc_matrix((values, self._indices, self._indptr), shape=(self.n, self.n))
        return splu(matrix, permc_spec="NATURAL", **SYMMETRIC)


def _minimum_degree(pattern: sp.csc_array) -> np.ndarray:
    """Return the position of each unknown in a fill-reducing order."""
    ones = pattern.copy()
    ones.data = np.full(pattern.nnz, -1.0)
    dominant = ones + sp.diags_array(2.0 + np.diff(pattern.indptr).astype(float))
    return splu(sp.csc_matrix(dominant), permc_spec="MMD_AT_PLUS_A", **SYMMETRIC).perm_c


class SuperLUSolver:
    """`eitbench.numerics.sparse_lu.SparseLU` by SuperLU's own substitution, column by column."""

    def __init__(self, matrix: sp.csr_array) -> None:
        self.factors = splu(sp.csc_matrix(matrix), permc_spec="MMD_AT_PLUS_A", **SYMMETRIC)

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return A⁻¹ b for (n, k)."""
        result = np.empty(right.shape)
        for column in range(right.shape[1]):      # rounding depends on the number of columns
            result[:, column] = self.factors.solve(right[:, column].astype(float))
        return result


class NumpySensitivity:
    """`eitbench.physics.sensitivity.Sensitivity` by products of arrays."""

    def __init__(self, basis: skfem.CellBasis) -> None:
        dim = basis.mesh.dim()
        self._cells = basis.mesh.t.T
        self._unknowns = basis.element_dofs.T
        corners = np.hstack([np.zeros((dim, 1)), np.eye(dim)])
        at_corners = skfem.Basis(basis.mesh, basis.elem, quadrature=(corners, np.ones(dim + 1)))
        gradient = np.stack([phi[0].grad.transpose(1, 2, 0) for phi in at_corners.basis], axis=-1)
        gradient = gradient.reshape(len(self._cells), -1, gradient.shape[-1])
        weight = basis.dx.sum(axis=1) / ((dim + 1) * (dim + 2) * (dim + 3))
        self._gradient = np.sqrt(weight)[:, None, None] * gradient

    def __call__(self, fields: np.ndarray) -> np.ndarray:
        """−∫ φ_j ∇w_m·∇w_l as (n_nodes, k, k), for potentials w (n_potential, k)."""
        n_cells, n_vertices = self._cells.shape
        k = fields.shape[1]
        at_vertices = self._gradient @ fields[self._unknowns]
        gradients = at_vertices.reshape(n_cells, n_vertices, n_vertices - 1, k)
        shifted = gradients + gradients.sum(axis=1, keepdims=True)
        own = np.swapaxes(gradients, 2, 3) @ gradients
        local = np.swapaxes(shifted, 2, 3) @ shifted + own + own.sum(axis=1, keepdims=True)
        corner = np.arange(self._cells.size)
        gather = sp.csr_array((np.full(self._cells.size, -1.0), (self._cells.ravel(), corner)))
        return (gather @ local.reshape(-1, k * k)).reshape(-1, k, k)


class AllColumns:
    """`ConvectionDiffusion._advance_wide` by `_substeps` of all columns at once."""

    def __init__(self, flow: transport.ConvectionDiffusion) -> None:
        self._flow = flow

    def advance(self, c, before, after, source=None):
        """Compute the same result; the first sub-step is two halves."""
        flow = self._flow
        loads = [0.0] * (flow.substeps + 1)
        if source is not None:
            loads = [0.5 * source] * 2 + [source] * (flow.substeps - 1)
        *_, last = flow._substeps(c, before, after, loads)
        return last


@contextmanager
def references():
    """Use these classes in electrode models and flows that are built within."""
    with (mock.patch.object(cem, "Condensation", SuperLUCondensation),
          mock.patch.object(cem, "Sensitivity", NumpySensitivity),
          mock.patch.object(transport, "SparseLU", SuperLUSolver)):
        yield


def reference_model(*arguments, **options) -> cem.CompleteElectrodeModel:
    """A `CompleteElectrodeModel` without compiled kernels."""
    with references():
        model = cem.CompleteElectrodeModel(*arguments, **options)
    assert isinstance(model._system, SuperLUCondensation)
    assert isinstance(model._sensitivity, NumpySensitivity)
    return model


def reference_flow(*arguments, **options) -> transport.ConvectionDiffusion:
    """A `ConvectionDiffusion` without compiled kernels."""
    with references():
        flow = transport.ConvectionDiffusion(*arguments, **options)
    flow._advance_wide = AllColumns(flow).advance
    return flow
