"""Sub-steps of a linear evolution for hundreds of columns: those of a transition matrix or a covariance."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from eitbench.physics._backend import kernels, scratch
from eitbench.physics.sparse_lu import ByRows, SparseLU


class WideSubsteps:
    """Sub-steps A c⁺ = E c − I c_in + f at the free nodes, the first two of them A c⁺ = r M c − I c_in + f/2.

    A few columns at a time go through all sub-steps, so that they stay in the processor's cache, and a substitution
    takes all of them at once. Each column becomes what it would be alone, to the bit.

    Parameters
    ----------
    solver : SparseLU
        Of A (n_free, n_free), compiled.
    mass, explicit : (n_free, n) sparse
        M and E.
    implicit_inlet : (n_free, n_inlet) sparse
        I.
    free, inlet : (n_free,) and (n_inlet,) int
        Nodes that A solves for, and those where the concentration is given.
    substeps : int
        How many take the inflow from its old value to the new one; the first is taken as two halves.
    rate : float
        r in 1/s.
    """

    def __init__(self, solver: SparseLU, mass: sp.csr_matrix, explicit: sp.csr_matrix,
                 implicit_inlet: sp.csr_matrix, free: np.ndarray, inlet: np.ndarray, substeps: int,
                 rate: float) -> None:
        rows, columns, self._lower, self._upper, self._scale = solver.factors
        self._rows = np.argsort(rows)
        self._place = free[np.argsort(columns)]
        self._mass = _by_rows(mass[self._rows])
        self._explicit = _by_rows(explicit[self._rows])
        self._implicit_inlet = _by_rows(implicit_inlet[self._rows])
        self._inlet = inlet
        self._substeps = substeps
        self._rate = rate

    def advance(self, c: np.ndarray, before: np.ndarray, after: np.ndarray,
                source: np.ndarray | None = None) -> np.ndarray:
        """All sub-steps.

        Parameters
        ----------
        c : (n, k)
            At the beginning; its inlet entries are replaced by ``before``.
        before, after : (n_inlet, k)
            c_in at the beginning and at the end; between them it moves linearly.
        source : (n_free, k), optional
            f, by default 0.

        Returns
        -------
        (n, k) at the end.
        """
        width = kernels().WIDE
        sizes = np.array([len(c), len(self._inlet), len(self._place), len(self._place)]) * width
        memory = scratch(int(sizes.sum()))
        memory[:] = 0.0                          # a last panel that is not full holds no numbers left by others
        state, inflow, load, work = np.split(memory, np.cumsum(sizes)[:-1])
        slope = (after - before) / self._substeps
        weight = float(source is not None)
        result = np.empty(c.shape)
        for first in range(0, c.shape[1], width):
            panel = slice(first, first + width)
            used = min(width, c.shape[1] - first)
            columns, given = state.reshape(-1, width), inflow.reshape(-1, width)
            columns[:, :used] = c[:, panel]
            columns[self._inlet, :used] = before[:, panel]
            if source is not None:
                load.reshape(-1, width)[:, :used] = source[self._rows, panel]
            for k in range(self._substeps + 1):
                halved = k < 2
                given[:, :used] = before[:, panel] + (k or 0.5) * slope[:, panel]
                kernels().substep_wide(self._mass if halved else self._explicit, self._rate if halved else 1.0,
                                       self._implicit_inlet, 0.5 * weight if halved else weight, self._lower,
                                       self._upper, self._scale, self._place, state, inflow, load, work)
                columns[self._inlet] = given
            columns[self._inlet, :used] = after[:, panel]
            result[:, panel] = columns[:, :used]
        return result


def _by_rows(matrix: sp.csr_matrix) -> ByRows:
    return matrix.indptr, matrix.indices, matrix.data
