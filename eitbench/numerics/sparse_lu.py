"""Sparse LU factorisation for many solves."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import SuperLU, spilu, splu

from eitbench.numerics.compiled import compiled_kernels, scratch

CsrArrays = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Pointers, indices and values of a sparse matrix, as in the kernels."""
MAX_FILL = 5.0
"""Entries of incomplete factors, relative to the matrix."""
NO_PIVOT: dict[str, Any] = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
"""Arguments of SuperLU."""


class LUFactors(NamedTuple):
    """Factors L and U with permutations."""

    row_perm: np.ndarray
    """(n,) position of each row in the elimination order"""
    columns: np.ndarray
    """(n,) column at each position of the elimination order"""
    lower: CsrArrays
    """(n, n) L without its diagonal, which is 1"""
    upper: CsrArrays
    """(n, n) U without its diagonal"""
    scale: np.ndarray
    """(n,) inverse of U's diagonal"""


class SparseLU:
    """Factorisation A = L U, ordered by minimum degree on A + Aᵀ as suits finite elements.

    The compiled substitution solves eight right-hand sides in the time of one. The solution of a
    right-hand side does not depend on the others, bit by bit.

    Parameters
    ----------
    matrix : (n, n) sparse
        With a symmetric pattern and a dominant diagonal: rows are not pivoted.
    drop : float
        Drop smaller entries of the factors, relative to their column, and keep the order of rows:
        an approximation with fewer entries, for iterations.

    Attributes
    ----------
    factors : LUFactors
    """

    def __init__(self, matrix: sp.csr_array, drop: float = 0.0) -> None:
        factors = (spilu(sp.csc_matrix(matrix), drop, MAX_FILL, permc_spec="NATURAL", **NO_PIVOT)
                   if drop else factorise_no_pivot(matrix, "MMD_AT_PLUS_A"))
        L = sp.csr_array(sp.tril(factors.L, -1))
        U = sp.csr_array(sp.triu(factors.U, 1))
        self.factors = LUFactors(factors.perm_r.astype(np.int64), np.argsort(factors.perm_c),
                                 (L.indptr, L.indices, L.data), (U.indptr, U.indices, U.data),
                                 1.0 / factors.U.diagonal())

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return A⁻¹ b for b (n, k)."""
        n, k = right.shape
        result = np.empty((n, k))
        eight, work, solution = scratch(3 * 8 * n).reshape(3, -1)
        for first in range(0, k, 8):
            block = right[:, first:first + 8]
            eight.reshape(n, 8)[:, :block.shape[1]] = block
            compiled_kernels().solve_lu(*self.factors, eight, work, solution)
            result[:, first:first + 8] = solution.reshape(n, 8)[:, :block.shape[1]]
        return result


def factorise_no_pivot(matrix: sp.csr_array | sp.csc_array, order: str) -> SuperLU:
    """Factorise without pivoting; ``order`` is SuperLU's name of the order of rows and columns."""
    return splu(sp.csc_matrix(matrix), permc_spec=order, **NO_PIVOT)
