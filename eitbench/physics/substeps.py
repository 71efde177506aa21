"""Sub-steps of a linear evolution for hundreds of columns, such as those of a covariance."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from eitbench.numerics.memory import scratch
from eitbench.numerics.sparse_lu import ByRows, SparseLU


class WideSubsteps:
    """Sub-steps A c⁺ = E c − I c_in + f of free nodes, the first two with r M for E and f/2 for f.

    A few columns at a time go through all sub-steps, so that they stay in the processor's cache,
    and a substitution takes all of them at once. Each becomes what it would be alone, to the bit.

    Parameters
    ----------
    solver : SparseLU
        Of A (n_free, n_free).
    mass, explicit : (n_free, n) sparse
        M and E.
    implicit_inlet : (n_free, n_inlet) sparse
        I.
    free, inlet : (n_free,) and (n_inlet,) int
        Nodes that A solves for, and those where the concentration is given.
    substeps : int
        How many take the inflow from its old value to the new one; the first is two halves.
    rate : float
        r in 1/s.
    """

    def __init__(self, solver: SparseLU, mass: sp.csr_matrix, explicit: sp.csr_matrix,
                 implicit_inlet: sp.csr_matrix, free: np.ndarray, inlet: np.ndarray, substeps: int,
                 rate: float) -> None:
        row_place, column_place, lower, upper, scale = solver.factors
        matrices = [_by_rows(matrix) for matrix in (mass, explicit, implicit_inlet)]
        unknown = free[np.argsort(column_place)]
        factors = (lower, upper, scale, row_place)
        self._arguments = (*matrices, *factors, unknown, inlet, substeps, rate)
        self._inlet = inlet
        self._substeps = substeps
        n_free = len(free)
        n_inlet = len(inlet)
        self._rows = (n_free + n_inlet, n_inlet, n_inlet, n_inlet, n_free, n_free)

    def advance(self, c: np.ndarray, before: np.ndarray, after: np.ndarray,
                source: np.ndarray | None = None) -> np.ndarray:
        """(n, k) after all sub-steps.

        Parameters
        ----------
        c : (n, k)
            At the beginning; its inlet entries are replaced by ``before``.
        before, after : (n_inlet, k)
            c_in at the beginning and at the end; between them it moves linearly.
        source : (n_free, k), optional
            f, by default 0.
        """
        from eitbench.numerics.wide_kernels import WIDE, advance_wide
        memory = scratch(sum(self._rows) * WIDE).reshape(-1, WIDE)
        blocks = np.split(memory, np.cumsum(self._rows)[:-1])
        state, first, slope, _, load, _ = blocks
        flat = [block.reshape(-1) for block in blocks]
        result = np.empty(c.shape)
        for begin in range(0, c.shape[1], WIDE):
            panel = slice(begin, begin + WIDE)
            used = slice(min(WIDE, c.shape[1] - begin))
            state[:, used] = c[:, panel]
            state[self._inlet, used] = before[:, panel]
            first[:, used] = before[:, panel]
            slope[:, used] = (after[:, panel] - before[:, panel]) / self._substeps
            if source is not None:
                load[:, used] = source[:, panel]
            advance_wide(*self._arguments, *flat[:5], source is not None, flat[5])
            state[self._inlet, used] = after[:, panel]
            result[:, panel] = state[:, used]
        return result


def _by_rows(matrix: sp.csr_matrix) -> ByRows:
    return matrix.indptr, matrix.indices, matrix.data
