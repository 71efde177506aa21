"""Speed of the complete electrode model: `python benchmarks/run.py forward`.

Conductivities are independent random values at the nodes; the pipe and its sixteen electrodes are
from `Pipe2D`.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Iterator

import numpy as np
import scipy.sparse as sp
import skfem
from common import Row, ceilings, compare, of_flops, peer, quantity
from solvers import entry_by_entry, pair_by_pair, refactorisations, splu_and_solves

from eitbench.numerics.fem import element, to_skfem
from eitbench.numerics.mesh import Mesh, graded_pipe_mesh
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.worlds.catalogue import PIPE_2D

SIZES = ((5, 13), (7, 20), (11, 32))
"""cells at an electrode and across: 4,300, 9,200 and 23,000 unknowns"""
BATCH = 64
PIPE = PIPE_2D.vessel


def rows() -> Iterator[Row]:
    for n, size in enumerate(SIZES):
        mesh = pipe_mesh(*size)
        cem = electrode_model(mesh)
        sigma = conductivities(mesh)
        K = system_matrix(cem, sigma[0])
        yield from against_solvers(cem, sigma[0], K, largest=size == SIZES[-1])
        if n < 2:
            yield in_batches(cem, sigma)
        yield from derivatives(cem, sigma[0], K)
    yield from against_pyeit()


def pipe_mesh(cells_at_electrodes: int, cells_across: int) -> Mesh:
    return graded_pipe_mesh(PIPE.length, PIPE.half_width, PIPE.electrode_spans, cells_at_electrodes,
                            cells_across)


def electrode_model(mesh: Mesh, **options) -> CompleteElectrodeModel:
    return CompleteElectrodeModel(mesh, PIPE.electrodes(mesh), PIPE.contact_impedance, **options)


def forget(cem: CompleteElectrodeModel) -> CompleteElectrodeModel:
    """Return the model without the results for the last conductivity that it keeps."""
    fresh = copy.copy(cem)
    fresh._last = fresh._last_resistance = None
    return fresh


def conductivities(mesh: Mesh, count: int = BATCH) -> np.ndarray:
    """(count, n_nodes) S/m"""
    return 0.3 * np.exp(0.2 * np.random.default_rng(0).standard_normal((count, mesh.n_nodes)))


def system_matrix(cem: CompleteElectrodeModel, sigma: np.ndarray) -> sp.csc_matrix:
    """Return both triangles of the grounded K(σ), with electrodes last; the solver stores one."""
    system = cem._system
    half = sp.csc_matrix((cem._assemble(sigma), (system.rows, system.columns)),
                         shape=(system.n, system.n))
    K = sp.csc_matrix(half + half.T - sp.diags(half.diagonal()))
    K.sort_indices()
    return K


def factor_flops(cem: CompleteElectrodeModel) -> float:
    """Count multiplications and additions of the factorisation, down to the electrodes' Schur
    complement."""
    start, first_row, *_ = cem._system._symbolic
    width, height = np.diff(start)[:-1], np.diff(first_row)[:-1]
    return float(sum(((h - np.arange(w))**2).sum() for w, h in zip(width, height, strict=True)))


def narrow(cem: CompleteElectrodeModel) -> str:
    """Describe the limit of a sparse factorisation, which is far below dgemm."""
    columns = np.diff(cem._system._symbolic[0])[:-1].mean()
    return f"flops, in supernodes of {columns:.1f} columns on average"


def against_solvers(cem: CompleteElectrodeModel, sigma: np.ndarray, K: sp.csc_matrix, *,
                    largest: bool
                    ) -> Iterator[Row]:
    """Compare all electrodes' voltages with factorisations without solutions."""
    everything = splu_and_solves(K, cem.n_electrodes - 1)
    ours = cem.transfer_resistance(sigma)
    np.testing.assert_allclose(ours, cem._centred(everything()), atol=1e-10 * np.abs(ours).max())
    bare, missing = refactorisations(K)
    candidates = {"ours": lambda: forget(cem).transfer_resistance(sigma), "all": everything, **bare}
    seconds = compare(candidates, 25)
    fastest = min(bare, key=seconds.__getitem__)
    listed = [f"{name} {quantity(seconds[name], 's')}"
              for name in sorted(bare, key=seconds.__getitem__)] + missing
    what = f"𝓡(σ), all injections, {cem.n_unknowns:,} unknowns"
    ceiling = of_flops(factor_flops(cem), seconds["ours"])
    limit = narrow(cem)
    yield Row("forward", what, f"one bare refactorisation, the fastest of: {', '.join(listed)}",
              seconds["ours"], seconds[fastest], "≤ 1.6×", limit, ceiling)
    yield Row("forward", what,
              f"{peer('scipy')} splu (MMD_AT_PLUS_A, symmetric mode) and 15 solves",
              seconds["ours"], seconds["all"], "≥ 5× faster" if largest else "", limit, ceiling)


def in_batches(cem: CompleteElectrodeModel, sigma: np.ndarray) -> Row:
    """Measure the time per state of a batch."""
    np.testing.assert_allclose(cem.transfer_resistance(sigma[:9])[8],
                               cem.transfer_resistance(sigma[8]), atol=1e-10)
    seconds = compare({"batch": lambda: cem.transfer_resistance(sigma),
                       "single": lambda: forget(cem).transfer_resistance(sigma[0])}, 25)
    each = seconds["batch"] / len(sigma)
    return Row("forward",
               f"𝓡(σ) of one of {len(sigma)} states given at once, {cem.n_unknowns:,} unknowns",
               "𝓡(σ) of one state", each, seconds["single"], "≤ 1/3",
               "flops, eight matrices side by side in vector registers",
               of_flops(factor_flops(cem), each))


# -- derivatives -----------------------------------------------------------------------------------


def derivatives(cem: CompleteElectrodeModel, sigma: np.ndarray, K: sp.csc_matrix) -> Iterator[Row]:
    """Compare the table, and the Jacobians of all pairs computed from it, with two solutions for
    each entry."""
    pairs = np.zeros((120, cem.n_electrodes))
    for k, (a, b) in enumerate(itertools.combinations(range(cem.n_electrodes), 2)):
        pairs[k, [a, b]] = 1.0, -1.0
    integrate = quadrature(cem.mesh)

    def naive() -> np.ndarray:
        return entry_by_entry(K, cem.n_electrodes - 1, integrate)

    def naive_pairs() -> np.ndarray:
        return pair_by_pair(K, pairs[:, :-1], integrate)

    table = cem.transfer_resistance_derivatives(sigma)[1]
    np.testing.assert_allclose(table, cem._centre @ naive() @ cem._centre.T,
                               atol=1e-8 * np.abs(table).max())
    seconds = compare({"table": lambda: forget(cem).transfer_resistance_derivatives(sigma),
                       "naive": naive}, 7, warm_up=False)
    seconds |= compare({"all": lambda: forget(cem).jacobian(sigma, pairs), "pairs": naive_pairs}, 1,
                       warm_up=False)
    seconds |= compare({"all": lambda: forget(cem).jacobian(sigma, pairs)}, 15)
    words = "two solves and ∫φ∇u·∇w by sparse gradient matrices for each of"
    flops, text = table_flops(cem)
    yield Row("forward", f"𝓡 and the table of its derivatives, {cem.n_unknowns:,} unknowns",
              f"{peer('scipy')} splu, and {words} the table's 120 entries", seconds["table"],
              seconds["naive"], "≥ 20× faster", f"flops: {text}", of_flops(flops, seconds["table"]))
    combining = 2.0 * table.size * len(pairs)
    written = 8e-9 * table.size / cem.n_electrodes * len(pairs)
    yield Row("forward", f"Jacobians of all 120 pairs, from the table, {cem.n_unknowns:,} unknowns",
              f"{peer('scipy')} splu, and {words} their 120 · 15 rows", seconds["all"],
              seconds["pairs"],
              "≥ 20× faster",
              f"the table; then {1e-6 * combining:.0f} MFlop to combine it, {1e3 * written:.0f} MB "
              "to write",
              f"{written / (seconds['all'] - seconds['table']):.2g} of {ceilings().copy / 2:.0f} "
              f"GB/s written, {of_flops(flops + combining, seconds['all'])}")


def quadrature(mesh: Mesh) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return a straightforward scikit-fem function of ∫ φ_j ∇u·∇w for all nodes j, exact for
    potentials of second order."""
    basis = skfem.Basis(to_skfem(mesh), element(2, 2), intorder=3)
    hats = basis.with_element(element(2, 1))
    point = np.arange(basis.dx.size).reshape(basis.dx.shape)

    def at_points(basis_: skfem.CellBasis,
                  value: Callable[[skfem.DiscreteField], np.ndarray]) -> sp.csr_array:
        entries = [(np.broadcast_to(value(phi[0]), point.shape).ravel(), point.ravel(),
                    np.repeat(dofs, point.shape[1]))
                   for phi, dofs in zip(basis_.basis, basis_.element_dofs, strict=True)]
        values, row, column = (np.concatenate(part) for part in zip(*entries, strict=True))
        return sp.csr_array((values, (row, column)), shape=(point.size, basis_.N))

    by_x, by_y = (at_points(basis, lambda phi, k=k: phi.grad[k]) for k in range(2))
    tested = sp.csr_array((at_points(hats, lambda phi: np.asarray(phi))
                           * basis.dx.ravel()[:, None]).T)

    def integrate(u: np.ndarray, w: np.ndarray) -> np.ndarray:
        u, w = u[:basis.N], w[:basis.N]
        return tested @ ((by_x @ u) * (by_x @ w) + (by_y @ u) * (by_y @ w))

    return integrate


def table_flops(cem: CompleteElectrodeModel) -> tuple[float, str]:
    """Return the flops of `transfer_resistance_derivatives`: sum, and text with all steps."""
    k = cem.n_electrodes
    n_cells = len(cem.mesh.cells)
    substitute = 2.0 * cem._system._symbolic[3][-1] * 16
    gradients = 2.0 * cem._sensitivity._gradient.size * k
    # 3 vertices: 2·2 for Σ_v G_v G_v, then 1 to add it and 2·2·2 for each vertex
    products = 39.0 * k**2 * n_cells
    parts = {"factor": factor_flops(cem), "substitution": substitute, "gradients": gradients,
             "their products": products}
    return sum(parts.values()), ", ".join(f"{name} {1e-6 * flops:.3g}" for name,
                                          flops in parts.items()) + " MFlop"


# -- pyEIT -----------------------------------------------------------------------------------------


def against_pyeit(cells: tuple[int, int] = (10, 26)) -> Iterator[Row]:
    """Compare with pyEIT on the same mesh, with first-order elements for both."""
    mesh = pipe_mesh(*cells)
    cem = electrode_model(mesh, order=1)
    currents = PIPE_2D.currents
    sigma = conductivities(mesh, 1)[0]
    works = {"voltages": lambda: forget(cem).voltages(sigma, currents),
             "jacobian": lambda: forget(cem).jacobian(sigma, currents)}
    theirs: dict[str, float | None] = dict.fromkeys(works)
    try:
        solver = pyeit_forward(mesh, currents)
        perm = sigma[mesh.cells].mean(axis=1)
        theirs["voltages"] = compare({"": lambda: solver.solve_eit(perm=perm)}, 3)[""]
        theirs["jacobian"] = compare({"": lambda: solver.compute_jac(perm=perm)}, 1,
                                     warm_up=False)[""]
    except ImportError:
        pass
    seconds = compare(works)
    flops, _ = table_flops(cem)
    differs = ("point electrodes instead of complete ones, a conductivity for each cell instead "
               "of each node")
    where = f"order 1, {mesh.n_nodes:,} nodes, {len(mesh.cells):,} cells"
    yield Row("forward", f"voltages of 16 injections, {where}",
              f"{peer('pyeit')} solve_eit on the same mesh: {differs}; factorises for each "
              "injection",
              seconds["voltages"], theirs["voltages"], "", narrow(cem),
              of_flops(factor_flops(cem), seconds["voltages"]))
    yield Row("forward", f"Jacobian of 16 injections, {where}",
              f"{peer('pyeit')} compute_jac on the same mesh: {differs}; inverts the dense matrix, "
              "loops over cells",
              seconds["jacobian"], theirs["jacobian"], "",
              "flops: products of gradients, and bytes of the table",
              of_flops(flops, seconds["jacobian"]))


def pyeit_forward(mesh: Mesh, currents: np.ndarray):
    """Return pyEIT's solver with point electrodes at the nodes nearest to electrode centres."""
    from pyeit.eit.fem import EITForward
    from pyeit.eit.protocol import PyEITProtocol
    from pyeit.mesh import PyEITMesh
    middles = [(x, y) for y in (-PIPE.half_width, PIPE.half_width) for x in
               PIPE.electrode_spans.mean(axis=1)]
    nodes = np.array([((mesh.points - middle)**2).sum(axis=1).argmin() for middle in middles])
    n = len(nodes)
    injections = np.stack([currents.argmax(axis=1), currents.argmin(axis=1)], axis=1)
    readings = np.stack([np.arange(n), (np.arange(n) + 1) % n], axis=1)
    protocol = PyEITProtocol(injections, np.tile(readings, (len(injections), 1, 1)),
                             np.ones(n * n, dtype=bool))
    return EITForward(PyEITMesh(mesh.points.copy(), mesh.cells.copy(), perm=1.0, el_pos=nodes),
                      protocol)
