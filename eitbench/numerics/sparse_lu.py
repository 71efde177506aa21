"""One sparse matrix, factorised once and solved with very often."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import SuperLU, splu

from eitbench.numerics.compiled import compiled_kernels, scratch

CsrArrays = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Pointers, indices and values of a sparse matrix, as the kernels want it."""


class LUFactors(NamedTuple):
    """L and U, for those who substitute themselves."""

    row_perm: np.ndarray
    """(n,) at which place in the order of elimination each row stands"""
    column_perm: np.ndarray
    """(n,) and each column"""
    lower: CsrArrays
    """(n, n) L without its diagonal, which is 1"""
    upper: CsrArrays
    """(n, n) U without its diagonal"""
    scale: np.ndarray
    """(n,) the inverse of U's diagonal"""


class SparseLU:
    """A = L U in an order by minimum degree on A + Aᵀ, which suits the matrices of finite elements.

    The compiled substitution takes eight right-hand sides in the time of one, and gives a
    right-hand side the same bits whatever stands beside it.

    Parameters
    ----------
    matrix : (n, n) sparse
        With a symmetric pattern and a large diagonal: nothing is pivoted.

    Attributes
    ----------
    factors : LUFactors
        For those who substitute themselves.
    """

    def __init__(self, matrix: sp.csr_array) -> None:
        factors = factorise_no_pivot(matrix, "MMD_AT_PLUS_A")
        L = sp.csr_array(sp.tril(factors.L, -1))
        U = sp.csr_array(sp.triu(factors.U, 1))
        self.factors = LUFactors(factors.perm_r.astype(np.int64), factors.perm_c.astype(np.int64),
                               (L.indptr, L.indices, L.data), (U.indptr, U.indices, U.data),
                               1.0 / factors.U.diagonal())

    def solve(self, right: np.ndarray) -> np.ndarray:
        """A⁻¹ b for (n, k)."""
        n, k = right.shape
        result = np.empty((n, k))
        rows, columns, lower, upper, scale = self.factors
        eight, work, solution = scratch(3 * 8 * n).reshape(3, -1)
        for first in range(0, k, 8):
            block = right[:, first:first + 8]
            eight.reshape(n, 8)[:, :block.shape[1]] = block
            compiled_kernels().solve_lu(rows, columns, *lower, *upper, scale, eight, work, solution)
            result[:, first:first + 8] = solution.reshape(n, 8)[:, :block.shape[1]]
        return result


def factorise_no_pivot(matrix: sp.csr_array | sp.csc_array, order: str) -> SuperLU:
    """L U without pivoting; ``order`` of the columns by SuperLU's name, the rows in the same."""
    return splu(sp.csc_matrix(matrix), permc_spec=order, diag_pivot_thresh=0.0,
                options={"SymmetricMode": True})
