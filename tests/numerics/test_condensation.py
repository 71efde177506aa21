"""Sparse systems condensed onto their last unknowns, against dense inverses."""

import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import scipy.sparse as sp
from eitbench.numerics import condensation
from eitbench.numerics.condensation import Condensation
from numpy.testing import assert_allclose, assert_array_equal


def random_pattern(n: int, n_ports: int, seed: int) -> sp.csc_array:
    """Return a connected symmetric pattern: a grid with random long edges, and ports with many neighbours."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(n - n_ports)))
    i = np.arange(n - n_ports)
    edges = [np.stack([i[:-1], i[1:]]), np.stack([i[:-side], i[side:]]), rng.integers(0, n - n_ports, (2, n // 10))]
    for port in range(n - n_ports, n):
        touched = rng.choice(n - n_ports, max(1, n // 8), replace=False)
        edges.append(np.stack([touched, np.full(len(touched), port)]))
    a, b = np.concatenate(edges, axis=1)
    entries = (np.ones(2 * len(a)), (np.append(a, b), np.append(b, a)))
    pattern = sp.coo_array(entries, shape=(n, n)).tocsc() + sp.eye_array(n, format="csc")
    pattern.data[:] = 1.0
    return pattern.tocsc()


def random_matrices(pattern: sp.csc_array, count: int, seed: int) -> list[np.ndarray]:
    """Return dense symmetric positive definite matrices of this pattern, weakly diagonally dominant."""
    rng = np.random.default_rng(seed)
    matrices = []
    for _ in range(count):
        upper = np.triu(pattern.toarray() * rng.uniform(-1.0, 0.2, pattern.shape), 1)
        K = upper + upper.T
        matrices.append(K + np.diag(np.abs(K).sum(axis=1) + rng.uniform(0.01, 1.0, len(K))))
    return matrices


def inverses(system: Condensation, values: np.ndarray) -> np.ndarray:
    """Return the ports' blocks of any number of matrices."""
    return np.concatenate([system.port_inverse(values[:, k:k + system.batch])
                           for k in range(0, values.shape[1], system.batch)])


def box_pattern(shape, n_ports):
    """Return a 3D grid with 27-point stencils and its coordinates; the ports, which are last, touch its end."""
    grid = np.meshgrid(*map(np.arange, shape), indexing="ij")
    places = np.stack(grid, axis=-1).reshape(-1, 3).astype(float)
    n = len(places)
    near = np.abs(places[:, None] - places).max(axis=2) <= 1
    full = np.zeros((n + n_ports, n + n_ports))
    full[:n, :n] = near
    full[n:, n:] = 1.0
    full[n:, n - 2 * n_ports:n] = full[n - 2 * n_ports:n, n:] = 1.0
    return sp.csc_array(full), places


@pytest.mark.parametrize(("pattern", "n_ports", "places"), [
    *((random_pattern(n, m, seed=n), m, None) for n, m in ((5, 1), (30, 3), (180, 15), (200, 17))),
    *((pattern, 2, places) for pattern, places in
      (box_pattern(shape, 2) for shape in ((4, 4, 30), (9, 9, 9), (1, 1, 5)))),
], ids=["5", "30", "180", "200", "long box", "cube", "line"])
def test_dense_inverse(pattern, n_ports, places):
    """The ports' block and columns of K⁻¹ equal the dense inverse, for one matrix and for many,
    also with nested dissection."""
    system = Condensation(pattern, n_ports, places)
    matrices = random_matrices(pattern, 11 if places is None else 1, seed=6)
    values = np.stack([K[system.rows, system.columns] for K in matrices], axis=1)
    exact = np.linalg.inv(np.array(matrices))
    tiny = 1e-12 * exact.max()
    assert_allclose(inverses(system, values), exact[:, -n_ports:, -n_ports:], rtol=0, atol=tiny)
    for column, inverse in zip(values.T, exact, strict=True):
        block = inverse[-n_ports:, -n_ports:]
        assert_allclose(system.port_inverse(column), block, rtol=0, atol=tiny)
        assert_allclose(system.port_columns(column), inverse[:, -n_ports:], rtol=0, atol=tiny)


def test_a_state_keeps_its_bits_wherever_it_stands_in_a_batch(monkeypatch):
    """Lanes are independent, and a batch of any length gives the same numbers. If eight matrices do
    not fit into the caches, each is factorised alone, with the same accuracy."""
    pattern = random_pattern(200, 6, seed=4)
    system = Condensation(pattern, 6)
    values = np.stack([K[system.rows, system.columns] for K in random_matrices(pattern, 20, seed=5)], axis=1)
    whole = inverses(system, values)
    backwards = inverses(system, values[:, ::-1])[::-1]
    assert_array_equal(whole, backwards)
    assert_array_equal(system.port_inverse(values[:, :3]), whole[:3])
    assert_array_equal(system.port_inverse(values[:, 13:14]), whole[13:14])
    monkeypatch.setattr(condensation, "_WIDEST", 0)
    alone = Condensation(pattern, 6)
    assert alone.batch == 1
    assert_allclose(inverses(alone, values), whole, rtol=1e-12, atol=0)


def test_systems_and_threads_do_not_disturb_each_other():
    """Working memory is shared by all systems of a thread, but not between threads."""
    systems, values = [], []
    for k, n in enumerate((60, 200, 150)):
        pattern = random_pattern(n, 5, seed=k)
        systems.append(Condensation(pattern, 5))
        (K,) = random_matrices(pattern, 1, seed=k)
        values.append(K[systems[-1].rows, systems[-1].columns])
    alone = [system.port_columns(each) for system, each in zip(systems, values, strict=True)]
    jobs = [k % 3 for k in range(120)]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda k: systems[k].port_columns(values[k]), jobs))
    np.testing.assert_equal(together, [alone[k] for k in jobs])


def test_numba_that_does_not_work_is_named(monkeypatch):
    """An error, for example of an unsupported numpy, names the problem and the remedy in one sentence."""
    system = Condensation(random_pattern(30, 2, seed=0), 2)
    monkeypatch.setitem(sys.modules, "eitbench.numerics.kernels", None)
    monkeypatch.delattr("eitbench.numerics.kernels", raising=False)
    with pytest.raises(RuntimeError, match=r"numba cannot be used \(.*\); reinstall eitbench"):
        system.port_inverse(np.ones(len(system.rows)))
