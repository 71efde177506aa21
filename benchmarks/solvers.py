"""Numeric refactorisations by other sparse solvers: new values with a known sparsity pattern.

Matrices are converted to each solver's preferred form before timing; no system is solved.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
from common import Work, peer
from scipy.sparse.linalg import splu

Integrate = Callable[[np.ndarray, np.ndarray], np.ndarray]
SYMMETRIC = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}


def refactorisations(K: sp.csc_matrix) -> tuple[dict[str, Work], list[str]]:
    """Return name and version → function for a symmetric positive definite K; missing peers."""
    found: dict[str, Work] = {}
    missing = []
    for package, prepare in (("qdldl", _qdldl), ("cholespy", _cholespy), ("pypardiso", _pardiso),
                             ("cvxopt", _cholmod), ("scipy", _superlu)):
        try:
            work, note = prepare(K)
            found[f"{peer(package)}{note}"] = work
        except ImportError:
            missing.append(peer(package))
    return found, missing


def _qdldl(K: sp.csc_matrix) -> tuple[Work, str]:
    import qdldl
    upper = sp.csc_matrix(sp.triu(K))
    solver = qdldl.Solver(upper, upper=True)
    return (lambda: solver.update(upper, upper=True)), ""


def _cholespy(K: sp.csc_matrix) -> tuple[Work, str]:
    import cholespy
    parts = K.shape[0], K.indptr, K.indices, K.data, cholespy.MatrixType.CSC
    return (lambda: cholespy.CholeskySolverD(*parts)), " (repeats the analysis)"


def _pardiso(K: sp.csc_matrix) -> tuple[Work, str]:
    from pypardiso import PyPardisoSolver
    upper = sp.csr_matrix(sp.triu(K))
    nothing = np.zeros((K.shape[0], 1))
    upper.sort_indices()
    solver = PyPardisoSolver(mtype=2)                    # real, symmetric positive definite
    solver._check_A(upper)
    solver.set_phase(11)                                 # analysis
    solver._call_pardiso(upper, nothing)
    solver.set_phase(22)                                 # numeric factorisation
    return (lambda: solver._call_pardiso(upper, nothing)), " (MKL PARDISO)"


def _cholmod(K: sp.csc_matrix) -> tuple[Work, str]:
    from cvxopt import cholmod, spmatrix
    lower = sp.tril(K).tocoo()
    matrix = spmatrix(lower.data.tolist(), lower.row.tolist(), lower.col.tolist(), K.shape)
    symbolic = cholmod.symbolic(matrix)
    return (lambda: cholmod.numeric(matrix, symbolic)), " (CHOLMOD)"


def _superlu(K: sp.csc_matrix) -> tuple[Work, str]:
    place = splu(K, permc_spec="MMD_AT_PLUS_A", **SYMMETRIC).perm_c
    order = np.argsort(place)
    permuted = sp.csc_matrix(K[order][:, order])
    permuted.sort_indices()
    return (lambda: splu(permuted, permc_spec="NATURAL", **SYMMETRIC)), " (splu, ordering reused)"


def splu_and_solves(K: sp.csc_matrix, n_ports: int) -> Callable[[], np.ndarray]:
    """Return a simple solution: factorise by SuperLU, ordered symmetrically; solve all loads."""
    loads = np.eye(K.shape[0], n_ports, n_ports - K.shape[0])
    return lambda: splu(K, permc_spec="MMD_AT_PLUS_A", **SYMMETRIC).solve(loads)[-n_ports:]


def entry_by_entry(K: sp.csc_matrix, n_ports: int, integrate: Integrate) -> np.ndarray:
    """Compute derivatives of the ports' block of K⁻¹, (n_nodes, m, m), with a forward and an
    adjoint solution for each entry."""
    n = K.shape[0]
    factors = splu(K, permc_spec="MMD_AT_PLUS_A", **SYMMETRIC)
    entries = {}
    for m, l in itertools.combinations_with_replacement(range(n_ports), 2):
        forward, adjoint = np.zeros((2, n))
        forward[n - n_ports + l] = adjoint[n - n_ports + m] = 1.0
        entries[m, l] = entries[l, m] = -integrate(factors.solve(forward), factors.solve(adjoint))
    columns = [entries[m, l] for m, l in np.ndindex(n_ports, n_ports)]
    return np.stack(columns, axis=1).reshape(-1, n_ports, n_ports)


def pair_by_pair(K: sp.csc_matrix, currents: np.ndarray, integrate: Integrate) -> np.ndarray:
    """Compute derivatives of the ports' voltages, (patterns, m, n_nodes), for currents (patterns,
    m), with two solutions per row."""
    n, n_ports = K.shape[0], currents.shape[1]
    factors = splu(K, permc_spec="MMD_AT_PLUS_A", **SYMMETRIC)
    rows = []
    for current, m in itertools.product(currents, range(n_ports)):
        forward, adjoint = np.zeros((2, n))
        forward[n - n_ports:], adjoint[n - n_ports + m] = current, 1.0
        rows.append(-integrate(factors.solve(forward), factors.solve(adjoint)))
    return np.array(rows).reshape(*currents.shape, -1)
