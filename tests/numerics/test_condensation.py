"""Sparse systems condensed onto their last unknowns, by both backends, against dense inverses."""

import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.testing import assert_allclose, assert_array_equal

from eitbench.numerics import condensation as condensation_module
from eitbench.numerics.condensation import condensation

both = pytest.mark.parametrize("backend", ["compiled", "scipy"])


def random_pattern(n: int, n_ports: int, seed: int) -> sp.csc_array:
    """A connected symmetric pattern: a planar-like grid with random long edges, and ports that touch many unknowns."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(n - n_ports)))
    i = np.arange(n - n_ports)
    edges = [np.stack([i[:-1], i[1:]]), np.stack([i[:-side], i[side:]]), rng.integers(0, n - n_ports, (2, n // 10))]
    for port in range(n - n_ports, n):
        touched = rng.choice(n - n_ports, max(1, n // 8), replace=False)
        edges.append(np.stack([touched, np.full(len(touched), port)]))
    a, b = np.concatenate(edges, axis=1)
    pattern = sp.coo_array((np.ones(2 * len(a)), (np.append(a, b), np.append(b, a))), shape=(n, n)).tocsc()
    pattern = pattern + sp.eye_array(n, format="csc")
    pattern.data[:] = 1.0
    return pattern.tocsc()


def random_matrices(pattern: sp.csc_array, count: int, seed: int) -> list[np.ndarray]:
    """Dense symmetric positive definite matrices of this pattern, not diagonally dominant by much."""
    rng = np.random.default_rng(seed)
    matrices = []
    for _ in range(count):
        upper = np.triu(pattern.toarray() * rng.uniform(-1.0, 0.2, pattern.shape), 1)
        K = upper + upper.T
        matrices.append(K + np.diag(np.abs(K).sum(axis=1) + rng.uniform(0.01, 1.0, len(K))))
    return matrices


CASES = pytest.mark.parametrize(("n", "n_ports"), [(5, 1), (30, 3), (180, 7), (400, 15), (400, 17)])


@both
@CASES
def test_dense_inverse(backend, n, n_ports):
    """The ports' block and the ports' columns of K⁻¹ are those of the dense inverse; one matrix or many."""
    pattern = random_pattern(n, n_ports, seed=n)
    system = condensation(pattern, n_ports, backend)
    matrices = random_matrices(pattern, 11, seed=n + 1)
    values = np.stack([K[system.rows, system.columns] for K in matrices], axis=1)
    exact = np.linalg.inv(np.array(matrices))
    assert_allclose(system.port_inverse(values), exact[:, -n_ports:, -n_ports:], rtol=0, atol=1e-12 * exact.max())
    for column, inverse in zip(values.T, exact, strict=True):
        assert_allclose(system.port_inverse(column), inverse[-n_ports:, -n_ports:], rtol=0, atol=1e-12 * exact.max())
        assert_allclose(system.port_columns(column), inverse[:, -n_ports:], rtol=0, atol=1e-12 * exact.max())


def box_pattern(shape, n_ports):
    """A 3D grid with 27-point stencils and its places; the last unknowns, the ports, touch the end of the grid."""
    places = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3).astype(float)
    n = len(places)
    near = np.abs(places[:, None] - places).max(axis=2) <= 1
    full = np.zeros((n + n_ports, n + n_ports))
    full[:n, :n], full[n:, n:] = near, 1.0
    full[n:, n - 2 * n_ports:n] = full[n - 2 * n_ports:n, n:] = 1.0
    return sp.csc_array(full), places


@both
@pytest.mark.parametrize("shape", [(4, 4, 30), (9, 9, 9), (1, 1, 5)])
def test_nested_dissection(backend, shape):
    """Ordered by where the unknowns lie, the ports' block and columns are those of the dense inverse as well."""
    pattern, places = box_pattern(shape, 2)
    system = condensation(pattern, 2, backend, places)
    (matrix,) = random_matrices(pattern, 1, seed=1)
    exact, values = np.linalg.inv(matrix), matrix[system.rows, system.columns]
    assert_allclose(system.port_inverse(values), exact[-2:, -2:], rtol=0, atol=1e-12 * exact.max())
    assert_allclose(system.port_columns(values), exact[:, -2:], rtol=0, atol=1e-12 * exact.max())


def test_nested_dissection_pays_in_a_box():
    """The Cholesky factor of a cube's grid takes fewer operations than by minimum degree."""
    pattern, places = box_pattern((14, 14, 14), 2)
    work = []
    for where in (None, places):
        place = condensation_module._ordered(pattern, 2, where)
        filled = condensation_module._filled(condensation_module._permuted(pattern, place))
        work.append(np.square(np.diff(filled.indptr).astype(float)).sum())
    assert work[1] < 0.9 * work[0]


def test_wide_fronts_are_taken_one_by_one(monkeypatch):
    """Where eight matrices would not fit side by side, each is factorised alone, to the same numbers."""
    pattern = random_pattern(180, 7, seed=2)
    values = np.stack([K[condensation(pattern, 7).rows, condensation(pattern, 7).columns]
                       for K in random_matrices(pattern, 3, seed=5)], axis=1)
    together = condensation(pattern, 7).port_inverse(values)
    monkeypatch.setattr(condensation_module, "_WIDEST", 0)
    alone = condensation(pattern, 7)
    assert alone.batch == 1
    assert_allclose(alone.port_inverse(values), together, rtol=1e-12, atol=0)


@both
def test_entries_are_complete(backend):
    """The entries asked for make up the whole pattern: at least one triangle, none twice, none outside."""
    pattern = random_pattern(120, 5, seed=3)
    system = condensation(pattern, 5, backend)
    asked = sp.coo_array((np.ones(len(system.rows)), (system.rows, system.columns)), shape=pattern.shape).toarray()
    assert asked.max() == 1.0
    assert_array_equal(np.maximum(asked, asked.T), pattern.toarray())


@both
def test_a_state_keeps_its_bits_wherever_it_stands_in_a_batch(backend):
    """Lanes do not speak to each other, and a batch of any length gives the same numbers."""
    pattern = random_pattern(200, 6, seed=4)
    system = condensation(pattern, 6, backend)
    values = np.stack([K[system.rows, system.columns] for K in random_matrices(pattern, 20, seed=5)], axis=1)
    whole = system.port_inverse(values)
    backwards = system.port_inverse(values[:, ::-1])[::-1]
    assert_array_equal(whole, backwards)
    assert_array_equal(system.port_inverse(values[:, :3]), whole[:3])
    assert_array_equal(system.port_inverse(values[:, 13:14]), whole[13:14])


def test_systems_and_threads_do_not_disturb_each_other():
    """Working memory is shared by all systems of a thread and by nobody else."""
    systems, values, alone = [], [], []
    for k, n in enumerate((60, 300, 150, 420)):
        pattern = random_pattern(n, 5, seed=k)
        system = condensation(pattern, 5, "compiled")
        K, = random_matrices(pattern, 1, seed=k)
        systems.append(system)
        values.append(K[system.rows, system.columns])
        alone.append(system.port_columns(values[-1]))
    jobs = [k % 4 for k in range(400)]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda k: systems[k].port_columns(values[k]), jobs))
    for k, columns in zip(jobs, together, strict=True):
        assert_array_equal(columns, alone[k])


@both
def test_pickled(backend):
    """A system sent to another process gives the same numbers."""
    pattern = random_pattern(90, 4, seed=6)
    system = condensation(pattern, 4, backend)
    K, = random_matrices(pattern, 1, seed=7)
    values = K[system.rows, system.columns]
    assert_array_equal(pickle.loads(pickle.dumps(system)).port_inverse(values), system.port_inverse(values))


def test_without_numba():
    """Where numba is not installed, scipy does the work, and asking for the kernels is an error that says so."""
    code = """
import sys, importlib.util
find = importlib.util.find_spec
importlib.util.find_spec = lambda name, *rest: None if name == "numba" else find(name, *rest)
sys.modules["numba"] = None
import numpy as np
from eitbench.numerics._backend import backend_version
from eitbench.worlds import Pipe2D
from eitbench.worlds.task import make_task
task = make_task(Pipe2D())
R, table = task.observation.cem.transfer_resistance_derivatives(np.full(task.observation.cem.mesh.n_nodes, 0.3))
print(backend_version(), abs(R).max() > 0, abs(table).max() > 0)
try:
    type(task.observation.cem)(task.observation.cem.mesh, task.observation.cem.electrodes, 1e-3, backend="compiled")
except ValueError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == ("scipy True True\nbackend 'compiled' needs numba, which is not installed: "
                           "pip install 'eitbench[fast]'\n")


def test_unknown_backend():
    with pytest.raises(ValueError, match="backend must be 'auto', 'compiled' or 'scipy', got 'pardiso'"):
        condensation(random_pattern(30, 2, seed=0), 2, "pardiso")  # type: ignore[arg-type]


def test_numba_that_does_not_work_is_named(monkeypatch):
    """Installed, but beside a numpy that is too new, say: no silent change of numbers, but a way out."""
    system = condensation(random_pattern(30, 2, seed=0), 2, "compiled")
    monkeypatch.setitem(sys.modules, "eitbench.numerics._kernels", None)
    monkeypatch.delattr("eitbench.numerics._kernels", raising=False)
    with pytest.raises(RuntimeError, match=r"numba [\d.]+ is installed but cannot be used .* uninstall it to compute"):
        system.port_inverse(np.ones(len(system.rows)))
