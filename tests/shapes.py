"""Shapes for the tests of the electrode model, and resistances computed without the code under test."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations, pairwise, permutations
from math import factorial
from typing import NamedTuple

import meshio
import numpy as np
from eitbench.numerics.mesh import Mesh, graded_interval, rectangle_mesh
from scipy.integrate import solve_ivp
from scipy.special import roots_jacobi, spherical_jn

# -- meshes -----------------------------------------------------------------------------------------------------------


def shaken_rectangle(width: float, height: float, cells: tuple[int, int], rng: np.random.Generator) -> Mesh:
    """Return a rectangle with its corner at the origin whose inner nodes are moved at random."""
    return _shaken(box_mesh((width, height), cells), np.array([width, height]), np.array(cells), rng)


def box_mesh(size: Sequence[float], cells: Sequence[int]) -> Mesh:
    """Return a rectangle or a box with its corner at the origin; each brick is split into six tetrahedra along one
    diagonal."""
    if len(size) == 2:
        return rectangle_mesh(*(np.linspace(0.0, length, n + 1) for length, n in zip(size, cells, strict=True)))
    shape = np.asarray(cells) + 1
    grid = [np.linspace(0.0, length, n) for length, n in zip(size, shape, strict=True)]
    points = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1).reshape(-1, 3)
    corner = np.ravel_multi_index(np.indices(cells).reshape(3, -1), shape)
    stride = np.array([shape[1] * shape[2], shape[2], 1])
    # Each order of the three axes is a path along brick edges from the lowest corner to the highest: one tetrahedron.
    tetrahedra = [corner[:, None] + np.concatenate([[0], np.cumsum(stride[list(path)])])
                  for path in permutations(range(3))]
    return Mesh(points, np.concatenate(tetrahedra))


def shaken_box(size: Sequence[float], cells: Sequence[int], rng: np.random.Generator) -> Mesh:
    """Return a box whose inner nodes are moved at random."""
    return _shaken(box_mesh(size, cells), np.asarray(size, dtype=float), np.asarray(cells), rng)


def _shaken(mesh: Mesh, size: np.ndarray, cells: np.ndarray, rng: np.random.Generator) -> Mesh:
    inner = ((mesh.points > 1e-9 * size) & (mesh.points < (1 - 1e-9) * size)).all(axis=1)
    move = rng.uniform(-0.15, 0.15, mesh.points.shape) * size / cells
    return Mesh(mesh.points + inner[:, None] * move, mesh.cells)


def end_facets(mesh: Mesh) -> list[np.ndarray]:
    """Return the boundary facets at the smallest and at the largest x."""
    x = mesh.points[:, 0]
    tiny = 1e-9 * np.ptp(x)
    return [mesh.facets_where(lambda p, end=end: np.abs(p[:, 0] - end) < tiny) for end in (x.min(), x.max())]


def polar_mesh(radii: np.ndarray, angles: np.ndarray) -> Mesh:
    """Return a mesh of nodes at all ``radii`` (m) and ``angles`` (rad, one turn); a disc if the first radius is 0."""
    n = len(angles)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    disc = int(radii[0] == 0.0)
    points = (np.asarray(radii)[disc:, None, None] * circle).reshape(-1, 2)
    here = np.arange(n)
    after = (here + 1) % n
    cells = []
    for ring in range(len(radii) - 1 - disc):
        a, b, c, d = (ring * n + here, ring * n + after, (ring + 1) * n + here, (ring + 1) * n + after)
        cells += [np.stack([a, c, d], axis=1), np.stack([a, d, b], axis=1)]
    if disc:
        cells.append(np.stack([np.full(n, len(points)), here, after], axis=1))
        points = np.concatenate([points, np.zeros((1, 2))])
    return Mesh(points, np.concatenate(cells))


def ring_facets(mesh: Mesh, radius: float, span: tuple[float, float] = (0.0, 2 * np.pi)) -> np.ndarray:
    """Return boundary facets with nodes at ``radius`` and from angle ``span[0]`` to ``span[1]``, ends included."""
    def on_arc(p: np.ndarray) -> np.ndarray:
        angle = np.mod(np.arctan2(p[:, 1], p[:, 0]) + 1e-9, 2 * np.pi)
        on_circle = np.abs(np.hypot(p[:, 0], p[:, 1]) - radius) < 1e-9 * radius
        return on_circle & (angle >= span[0]) & (angle <= span[1] + 2e-9)
    return mesh.facets_where(on_arc)


def disc_mesh(radius: float, spans: np.ndarray, cells: int, grading: float = 1.5) -> tuple[Mesh, list[np.ndarray]]:
    """Return a disc and its electrodes: ``cells`` on each electrode and gap, denser at the edges, 2 × on a radius.

    ``spans`` (L, 2) are the electrodes' first and last angles, increasing within [0, 2π).
    """
    edges = np.append(spans.ravel(), spans[0, 0] + 2 * np.pi)
    angles = np.concatenate([graded_interval(a, b, cells, grading)[:-1] for a, b in pairwise(edges)])
    mesh = polar_mesh(graded_interval(0.0, radius, 2 * cells, grading, "stop"), angles)
    return mesh, [ring_facets(mesh, radius, tuple(span)) for span in spans]


# -- resistances without a mesh ---------------------------------------------------------------------------------------


def slab_resistance(length: float, area: float, conductivity: float, contact_impedance: Sequence[float]) -> float:
    """Return the resistance between two ends covered by electrodes: the current is uniform."""
    return length / (conductivity * area) + sum(contact_impedance) / area


def annulus_resistance(a: float, b: float, conductivity: float, contact_impedance: Sequence[float]) -> float:
    """Return the resistance between the inner and the outer circle: the current is radial."""
    inner, outer = contact_impedance
    return np.log(b / a) / (2 * np.pi * conductivity) + inner / (2 * np.pi * a) + outer / (2 * np.pi * b)


def disc_modes(conductivity: Callable[[np.ndarray], np.ndarray], radius: float, modes: int = 40) -> np.ndarray:
    """Return Λ_n = (potential / current density) of cos nθ at the wall, n = 1 … modes, for a radial σ(r).

    With u = f(r) cos nθ, (rσf')' = n²σf/r; the quotient w = rσf'/(nf) obeys dw/d(ln r) = n(σ² − w²)/σ, is σ at the
    centre, where σ must be constant, and Λ_n = radius/(n w(radius)).
    """
    n = np.arange(1, modes + 1)

    def slope(x: float, w: np.ndarray) -> np.ndarray:
        sigma = conductivity(np.exp(x))
        return n * (sigma**2 - w**2) / sigma

    centre = 1e-3 * radius
    solution = solve_ivp(slope, np.log([centre, radius]), np.full(modes, float(conductivity(centre))),
                         rtol=1e-10, atol=1e-12)
    return radius / (n * solution.y[:, -1])


def disc_resistance(radius: float, spans: np.ndarray, contact_impedance: np.ndarray, modes: np.ndarray,
                    wall_conductivity: float, degree: int = 24, n_modes: int = 15_000) -> np.ndarray:
    """Return 𝓡 of a disc under the complete electrode model, without a mesh.

    The current density of electrode l is a sum of Legendre polynomials over its arc; its Fourier coefficients are
    spherical Bessel functions, mode n of the potential is Λ_n times mode n of the density, and u + z j = U_l is tested
    with the same polynomials: G j = (U_l |e_l| on the constants). ``modes`` holds the first Λ_n, the others belong to
    a uniform ``wall_conductivity``.
    """
    n = np.arange(1, n_modes + 1)
    symbol = radius / (n * wall_conductivity)
    symbol[:len(modes)] = modes
    centre, half = spans.mean(axis=1), 0.5 * np.ptp(spans, axis=1)
    k = np.arange(degree + 1)
    bessel = np.stack([spherical_jn(k[:, None], n * h) for h in half])                   # (L, k, n)
    fourier = (2 * half[:, None, None] * (-1j)**k[:, None] * bessel * np.exp(-1j * n * centre[:, None, None]))
    fourier = fourier.reshape(-1, n_modes)
    G = radius**2 / np.pi * (fourier * (symbol / radius) @ fourier.conj().T).real
    arc = 2 * radius * half
    G += np.diag((contact_impedance[:, None] * arc[:, None] / (2 * k + 1)).ravel())
    constants = np.zeros((len(G), len(spans)))
    constants[np.arange(len(spans)) * (degree + 1), np.arange(len(spans))] = arc
    # j = G⁻¹ C (U − u₀) and I = Cᵀ j give the conductance between electrodes for a free mean u₀ of the potential.
    grounded = np.linalg.inv(constants.T @ np.linalg.solve(G, constants))
    centring = np.eye(len(spans)) - 1.0 / len(spans)
    return centring @ grounded @ centring


# -- an independent solution: dense, cell by cell, with more quadrature than needed -----------------------------------

class DenseSolution(NamedTuple):
    voltages: np.ndarray             # (K, L)
    volume_loss: np.ndarray          # (K,) ∫σ|∇u|²
    contact_loss: np.ndarray         # (K,) Σ z_l ∫_{e_l} j²,  j = (U_l − u)/z_l
    electrode_currents: np.ndarray   # (K, L) ∫_{e_l} j


def dense_solution(mesh: Mesh, electrodes: list[np.ndarray], z: np.ndarray, order: int, sigma: np.ndarray,
                   currents: np.ndarray) -> DenseSolution:
    """Solve the saddle-point system of the complete electrode model with ΣU = 0 as a separate row."""
    d = mesh.dim
    number: dict[tuple[int, ...], int] = {(i,): i for i in range(mesh.n_nodes)}

    def unknowns(nodes: np.ndarray) -> list[int]:
        edges = [tuple(sorted((int(nodes[i]), int(nodes[j])))) for i, j in combinations(range(len(nodes)), 2)]
        return [int(n) for n in nodes] + ([number.setdefault(e, len(number)) for e in edges] if order == 2 else [])

    cells = [unknowns(cell) for cell in mesh.cells]
    n, L = len(number), len(electrodes)
    conduction = np.zeros((n + L, n + L))
    bary, weight = simplex_rule(d)
    _, slope = lagrange(bary, order)
    for cell, dofs in zip(mesh.cells, cells, strict=True):
        frame = np.linalg.inv(np.vstack([np.ones(d + 1), mesh.points[cell].T]))
        volume = 1.0 / (abs(np.linalg.det(frame)) * factorial(d))
        gradient = slope @ frame[:, 1:]
        conduction[np.ix_(dofs, dofs)] += volume * np.einsum("q,qad,qbd->ab", weight * (bary @ sigma[cell]),
                                                             gradient, gradient)
    contact = np.zeros((n + L, n + L))
    flow = np.zeros((L, n + L))                                       # ∫_{e_l} j as a row on (u, U)
    bary, weight = simplex_rule(d - 1)
    value, _ = lagrange(bary, order)
    for l, facets in enumerate(electrodes):
        for facet in facets:
            edges = mesh.points[facet[1:]] - mesh.points[facet[0]]
            dofs = [*unknowns(facet), n + l]
            drop = np.hstack([-value, np.ones((len(value), 1))]) / z[l]           # j at the quadrature points
            area = np.sqrt(np.linalg.det(edges @ edges.T)) / factorial(d - 1) * weight
            contact[np.ix_(dofs, dofs)] += z[l] * (drop.T * area) @ drop
            flow[l, dofs] += area @ drop
    sum_to_zero = np.append(np.zeros(n), np.ones(L))[:, None]
    saddle = np.block([[conduction + contact, sum_to_zero], [sum_to_zero.T, np.zeros((1, 1))]])
    load = np.vstack([np.zeros((n, len(currents))), currents.T, np.zeros((1, len(currents)))])
    x = np.linalg.solve(saddle, load)[:-1]
    return DenseSolution(x[n:].T, np.einsum("ik,ij,jk->k", x, conduction, x), np.einsum("ik,ij,jk->k", x, contact, x),
                         (flow @ x).T)


def simplex_rule(d: int, points: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Return barycentric points and weights (sum 1) of a collapsed cube of Gauss–Jacobi points; exact to degree 9."""
    bary, weight = np.ones((1, 1)), np.ones(1)
    for k in range(1, d + 1):
        t, w = roots_jacobi(points, k - 1, 0)                         # weight (1 − t)^(k−1) of the collapsed directions
        t, w = 0.5 * (t + 1), w / w.sum()
        bary = np.concatenate([np.concatenate([np.full((len(bary), 1), s), (1 - s) * bary], axis=1) for s in t])
        weight = np.kron(w, weight)
    return bary, weight


def lagrange(bary: np.ndarray, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Return shape functions (q, n) at barycentric points, nodes before edges, and their slopes (q, n, d + 1)."""
    vertices = bary.shape[1]
    unit = np.eye(vertices)
    if order == 1:
        return bary, np.broadcast_to(unit, (len(bary), vertices, vertices))
    edges = list(combinations(range(vertices), 2))
    value = [bary[:, i] * (2 * bary[:, i] - 1) for i in range(vertices)]
    slope = [(4 * bary[:, i:i + 1] - 1) * unit[i] for i in range(vertices)]
    value += [4 * bary[:, i] * bary[:, j] for i, j in edges]
    slope += [4 * (bary[:, i:i + 1] * unit[j] + bary[:, j:j + 1] * unit[i]) for i, j in edges]
    return np.stack(value, axis=1), np.stack(slope, axis=1)


def write_mesh(path, mesh: Mesh, groups: dict | None = None) -> None:
    """Write a mesh and groups of boundary facets as text, in gmsh's format 2.2."""
    names = {2: ("triangle", "line"), 3: ("tetra", "triangle")}[mesh.dim]
    cells = [(names[0], mesh.cells)] + [(names[1], np.asarray(facets)) for facets in (groups or {}).values()]
    tags = [np.full(len(data), tag) for tag, (_, data) in enumerate(cells)]
    meshio.Mesh(
        np.pad(mesh.points, ((0, 0), (0, 3 - mesh.dim))), cells,
        cell_data={"gmsh:physical": tags, "gmsh:geometrical": [tag + 1 for tag in tags]},
        field_data={name: np.array([1 + k, mesh.dim - 1]) for k, name in enumerate(groups or {})},
    ).write(path, file_format="gmsh22", binary=False)


# -- fields on triangles, without the package's finite elements --------------------------------------------------------


def values_at(points, mesh):
    """Return the dense matrix from nodal values on ``mesh`` to ``points``, with a search of all cells."""
    matrix, found = np.zeros((len(points), mesh.n_nodes)), np.zeros(len(points), dtype=bool)
    homogeneous = np.column_stack([points, np.ones(len(points))])
    for cell in mesh.cells:
        weights = homogeneous @ np.linalg.inv(np.column_stack([mesh.points[cell], np.ones(3)]))
        inside = (weights > -1e-9).all(axis=1) & ~found
        matrix[np.ix_(inside, cell)] = weights[inside]
        found |= inside
    assert found.all()
    return matrix


def integral_of_square(mesh, nodal, region=(-np.inf, np.inf)):
    """∫f² for nodal values (..., n) over the triangles within a range of x: the three midpoints of a triangle's edges
    integrate a quadratic exactly."""
    x = mesh.points[mesh.cells][..., 0]
    cells = mesh.cells[(x.min(axis=1) > region[0] - 1e-9) & (x.max(axis=1) < region[1] + 1e-9)]
    corner = nodal[..., cells]
    middles = 0.5 * (corner + np.roll(corner, 1, axis=-1))
    edges = mesh.points[cells[:, 1:]] - mesh.points[cells[:, :1]]
    area = 0.5 * np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
    return (middles**2).mean(axis=-1) @ area


def uniform(*velocity):
    """Return a field with this value everywhere."""
    return lambda points: np.broadcast_to(np.array(velocity, dtype=float), points.shape)


def orders(errors):
    """Return log₂ of the reduction of the error by each halving of the cells or steps."""
    return np.array([np.log2(coarse / fine) for coarse, fine in pairwise(errors)])


class RootLaw:
    """σ = (a − b√c) c: a nonlinear conductivity law."""

    a, b = 0.0126, 2.8e-4

    def __call__(self, concentration):
        return (self.a - self.b * np.sqrt(concentration)) * concentration

    def derivative(self, concentration):
        return self.a - 1.5 * self.b * np.sqrt(concentration)
