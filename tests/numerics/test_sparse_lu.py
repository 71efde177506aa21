"""Sparse LU factors against dense solutions; columns are independent."""

import numpy as np
import pytest
import scipy.sparse as sp
from eitbench.numerics.sparse_lu import SparseLU
from numpy.testing import assert_allclose, assert_array_equal

WIDTHS = (1, 7, 8, 9, 20)


def random_matrix(n, seed):
    """Return a matrix with symmetric pattern, unsymmetric values of both signs, and weak diagonal dominance.

    The unknowns are numbered at random.
    """
    rng = np.random.default_rng(seed)
    i = np.arange(n)
    edges = np.concatenate([np.stack([i[:-1], i[1:]]), rng.integers(0, n, (2, n))], axis=1)
    edges = rng.permutation(n)[edges[:, edges[0] != edges[1]]]
    A = np.zeros((n, n))
    size = rng.uniform(0.1, 1.0, edges.shape[1])
    A[edges[0], edges[1]] = size * rng.choice([-1.0, 1.0], edges.shape[1])
    A[edges[1], edges[0]] = rng.uniform(0.1, 1.0, edges.shape[1])
    A[i, i] = (np.abs(A).sum(axis=1) + rng.uniform(0.01, 0.5, n)) * rng.choice([-1.0, 1.0], n)
    return A


@pytest.mark.parametrize("n", [1, 9, 120])
@pytest.mark.parametrize("k", WIDTHS)
def test_dense_solution(n, k):
    """A⁻¹ b equals dense elimination for several right-hand sides; b is unchanged."""
    A = random_matrix(n, seed=n)
    right = np.random.default_rng(k).normal(size=(n, k))
    kept = right.copy()
    assert n < 3 or np.abs(A - A.T).max() > 0.1
    solution = SparseLU(sp.csr_array(A)).solve(right)
    assert solution.shape == (n, k)
    exact = np.linalg.solve(A, right)
    assert_allclose(solution, exact, rtol=0, atol=1e-12 * np.abs(exact).max())
    assert_array_equal(right, kept)


def test_a_column_does_not_depend_on_others():
    """A solution does not depend on the batch, its length, the position, the memory layout, or NaN in other columns."""
    solver = SparseLU(sp.csr_array(random_matrix(200, seed=3)))
    right = np.random.default_rng(4).normal(size=(200, 20))
    whole = solver.solve(right)
    assert_array_equal(solver.solve(right[:, ::-1])[:, ::-1], whole)
    assert_array_equal(solver.solve(np.asfortranarray(right)), whole)
    for k in WIDTHS:
        assert_array_equal(solver.solve(right[:, :k]), whole[:, :k])
    for j in range(20):
        assert_array_equal(solver.solve(right[:, j:j + 1])[:, 0], whole[:, j])
    beside = right.copy()
    beside[:, 1::2] = np.array([np.nan, np.inf, 1e300, -1e-300, 0.0, 1.0, -np.inf, np.nan, 1e9, 5.0])
    assert_array_equal(solver.solve(beside)[:, ::2], whole[:, ::2])
