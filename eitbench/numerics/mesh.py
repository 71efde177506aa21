"""Simplex meshes from plain arrays: nodes, cells, boundary facets, and linear interpolation."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import factorial

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

from eitbench import _check

CANDIDATES = 32
"""Cells, nearest by centroid, in which a point is searched first; then in all near enough."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """A mesh of triangles (2D) or tetrahedra (3D).

    ``ValueError`` if shapes are wrong, a coordinate is not finite, a node number is out of range, a
    node belongs to no cell, or a cell has no volume.

    Parameters
    ----------
    points : (n_nodes, d) float
        Node coordinates in m, d = 2 or 3.
    cells : (n_cells, d + 1) int
        Node numbers of each simplex; the orientation does not matter.
    """

    points: np.ndarray
    cells: np.ndarray

    def __post_init__(self) -> None:
        points = _check.array("points", self.points, (None, None), units="m")
        cells = np.asarray(self.cells)
        d = points.shape[1]
        if d not in (2, 3):
            raise ValueError("points must have shape (n_nodes, 2) or (n_nodes, 3), "
                             f"got {points.shape}")
        if cells.ndim != 2 or cells.shape[1] != d + 1 or not np.issubdtype(cells.dtype, np.integer):
            raise ValueError(f"cells must be integers of shape (n_cells, {d + 1}) in {d}D, "
                             f"got {cells.dtype} of shape {cells.shape}")
        cells = cells.astype(np.int64)
        if cells.size == 0 or cells.min() < 0 or cells.max() >= len(points):
            raise ValueError(f"cells must hold node numbers in [0, {len(points) - 1}], "
                             "and at least one cell")
        unused = np.setdiff1d(np.arange(len(points)), cells)
        if unused.size:
            raise ValueError(f"points must all belong to a cell; {unused.size} do not, "
                             f"the first is node {unused[0]}")
        for name, value in (("points", points.copy()), ("cells", cells)):
            value.setflags(write=False)  # meshes are shared, and derived arrays are cached
            object.__setattr__(self, name, value)
        size = np.ptp(points, axis=0).max()
        flat = np.flatnonzero(self.volumes <= 1e-14 * size**d)
        if flat.size:
            raise ValueError(f"cells must have a positive volume; cell {flat[0]} has nodes "
                             f"{cells[flat[0]].tolist()} on one line or plane")

    @property
    def dim(self) -> int:
        """Number of space dimensions, 2 or 3."""
        return self.points.shape[1]

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return len(self.points)

    @cached_property
    def volumes(self) -> np.ndarray:
        """(n_cells,) area in m² (2D) or volume in m³ (3D) of each cell."""
        corner = self.points[self.cells]
        return np.abs(np.linalg.det(corner[:, 1:] - corner[:, :1])) / factorial(self.dim)

    @cached_property
    def boundary_facets(self) -> np.ndarray:
        """(n_facets, d) node numbers, sorted in each row, of facets that belong to one cell."""
        return self._boundary[0]

    @cached_property
    def _boundary(self) -> tuple[np.ndarray, np.ndarray]:
        """The boundary facets (n_facets, d) and the cell (n_facets,) that each belongs to."""
        d = self.dim
        facets = np.concatenate([np.delete(self.cells, i, axis=1) for i in range(d + 1)])
        facets, first, count = np.unique(np.sort(facets, axis=1), axis=0, return_index=True,
                                         return_counts=True)
        return facets[count == 1], first[count == 1] % len(self.cells)

    def facets_where(self, predicate: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Return boundary facets (n_facets, d) with all nodes in ``predicate(points) -> bool``."""
        return self.facets_of(np.asarray(predicate(self.points), dtype=bool))

    def facets_of(self, inside: np.ndarray) -> np.ndarray:
        """Return boundary facets (n_facets, d) with all nodes ``inside``, (n_nodes,) bool."""
        return self.boundary_facets[inside[self.boundary_facets].all(axis=1)]

    @cached_property
    def _cell_tree(self) -> tuple[cKDTree, float]:
        return _tree(self.points[self.cells])

    @cached_property
    def _wall_tree(self) -> tuple[cKDTree, float]:
        return _tree(self.points[self.boundary_facets])

    def locate(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the cell (k,) int of each of ``points``, and barycentric coordinates (k, d + 1).

        The coordinates are in the order of the cell's nodes, nonnegative, with row sums of one. The
        cell of a point outside the mesh is the cell of the nearest boundary facet.

        ``ValueError`` if ``points`` has the wrong shape or is not finite.

        Parameters
        ----------
        points : (k, d) float
            In m. A point outside the mesh (by rounding, or because a curved wall is a polygon here)
            is moved to the nearest point of the boundary (in 3D, if the nearest point is on an
            edge of a facet, to a point nearly as near).
        """
        points = _check.array("points", points, (None, self.dim), units="m")
        k = min(CANDIDATES, len(self.cells))
        tree, reach = self._cell_tree
        near = tree.query(points, k=k)[1].reshape(len(points), k)
        best, weights = self._best_cell(points, near)
        for lost in _parts(weights.min(axis=1) < -1e-9):
            around = tree.query_ball_point(points[lost], (1.0 + 1e-9) * reach, return_sorted=True)
            cells = [found or [old] for found, old in zip(around, best[lost], strict=True)]
            best[lost], weights[lost] = self._best_cell(points[lost], _rectangular(cells))
        for lost in _parts(weights.min(axis=1) < -1e-9):
            # The cell with the least negative coordinate may be a large one far inside.
            best[lost], weights[lost] = self._nearest_wall(points[lost])
        weights = np.clip(weights, 0.0, None)
        weights /= weights.sum(axis=1, keepdims=True)
        return best, weights

    def interpolation_to(self, points: np.ndarray) -> sp.csr_array:
        """Return the matrix (k, n_nodes) of linear interpolation to ``points``; row sums are one.

        A point outside the mesh takes the value at the nearest point of the boundary.
        """
        cells, weights = self.locate(points)
        rows = np.repeat(np.arange(len(cells)), self.dim + 1)
        matrix = sp.csr_array((weights.ravel(), (rows, self.cells[cells].ravel())),
                              shape=(len(cells), self.n_nodes))
        matrix.eliminate_zeros()
        return matrix

    def _nearest_wall(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the cells of the nearest boundary facets, and coordinates of the projections."""
        tree, reach = self._wall_tree
        radius = (1.0 + 1e-9) * (tree.query(points)[0] + reach)
        near = _rectangular(tree.query_ball_point(points, radius, return_sorted=True))
        facets, cells = (array[near] for array in self._boundary)
        corner = self.points[facets]                                                # (k, f, d, d)
        edges = corner[:, :, 1:] - corner[:, :, :1]
        gram = edges @ np.swapaxes(edges, 2, 3)
        from_corner = points[:, None] - corner[:, :, 0]
        local = np.linalg.solve(gram, edges @ from_corner[..., None])[..., 0]
        weights = np.concatenate([1.0 - local.sum(axis=2, keepdims=True), local], axis=2)
        weights = np.clip(weights, 0.0, None)
        weights /= weights.sum(axis=2, keepdims=True)
        moved = np.einsum("kfi,kfid->kfd", weights, corner)
        nearest = np.linalg.norm(moved - points[:, None], axis=2).argmin(axis=1)
        row = np.arange(len(points))
        best = cells[row, nearest]
        same_node = self.cells[best][:, :, None] == facets[row, nearest][:, None]   # (k, d + 1, d)
        return best, (same_node @ weights[row, nearest][:, :, None])[..., 0]

    @cached_property
    def _gradients(self) -> np.ndarray:
        """(n_cells, d + 1, d) gradients of the barycentric coordinates."""
        corner = self.points[self.cells]
        others = np.linalg.inv(np.swapaxes(corner[:, 1:] - corner[:, :1], 1, 2))
        return np.concatenate([-others.sum(axis=1, keepdims=True), others], axis=1)

    def _best_cell(self, points: np.ndarray,
                   candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the best cell among each point's candidates, and barycentric coordinates."""
        from_corner = points[:, None] - self.points[self.cells[candidates, 0]]          # (k, c, d)
        barycentric = np.einsum("kcij,kcj->kci", self._gradients[candidates], from_corner)
        barycentric[:, :, 0] += 1.0
        which = barycentric.min(axis=2).argmax(axis=1)
        row = np.arange(len(points))
        return candidates[row, which], barycentric[row, which]


def _parts(chosen: np.ndarray, size: int = 100) -> list[np.ndarray]:
    """Return the numbers of the chosen points, in parts that limit the memory."""
    numbers = np.flatnonzero(chosen)
    return [numbers[begin:begin + size] for begin in range(0, len(numbers), size)]


def _rectangular(rows: Sequence[list[int]] | np.ndarray) -> np.ndarray:
    """Return lists of numbers as one array; shorter ones repeat their first number."""
    width = max(map(len, rows))
    return np.array([row + row[:1] * (width - len(row)) for row in rows])


def _tree(corner: np.ndarray) -> tuple[cKDTree, float]:
    """Return a tree of the centroids of cells or facets (k, nodes, d), and their largest radius."""
    middle = corner.mean(axis=1)
    return cKDTree(middle), float(np.linalg.norm(corner - middle[:, None], axis=2).max())


def validate_facets(name: str, facets: np.ndarray, mesh: Mesh) -> np.ndarray:
    """Return ``facets`` as node numbers (k ≥ 1, d); ``ValueError`` with their name otherwise."""
    facets = np.asarray(facets)
    if (facets.ndim != 2 or facets.shape[1] != mesh.dim or len(facets) == 0
            or not np.issubdtype(facets.dtype, np.integer)):
        raise ValueError(f"{name} must be integers of shape (n_facets ≥ 1, {mesh.dim}), "
                         f"got {facets.dtype} of shape {facets.shape}")
    return facets


def facet_set(facets: np.ndarray) -> set[tuple[int, ...]]:
    """Return facets as tuples of node numbers."""
    return set(map(tuple, facets.tolist()))


def check_increasing(name: str, line: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return (k ≥ 2,) coordinates in m; ``ValueError`` with their name if they do not increase."""
    line = _check.array(name, line, (None,), units="m")
    if len(line) < 2 or (np.diff(line) <= 0).any():
        raise ValueError(f"{name} must hold at least two strictly increasing coordinates in m, "
                         f"got {line!r}")
    return line


def rectangle_mesh(x: Sequence[float] | np.ndarray, y: Sequence[float] | np.ndarray) -> Mesh:
    """Return structured triangles on the grid of increasing coordinates ``x`` and ``y`` (m).

    Nodes are numbered by cross-section (all ``y`` of the first ``x``, then of the second, ...), so
    that matrices on this mesh are banded with half-bandwidth ``len(y) + 1``. Diagonals alternate,
    which keeps the mesh symmetric.
    """
    x = check_increasing("x", x)
    y = check_increasing("y", y)
    ny = len(y)
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    corners = np.meshgrid(np.arange(len(x) - 1), np.arange(ny - 1), indexing="ij")
    i, j = (index.ravel() for index in corners)
    sw, nw = i * ny + j, i * ny + j + 1
    se, ne = sw + ny, nw + ny
    rising = ((i + j) % 2 == 0)[:, None]
    first = np.where(rising, np.stack([sw, se, ne], axis=1), np.stack([sw, se, nw], axis=1))
    second = np.where(rising, np.stack([sw, ne, nw], axis=1), np.stack([se, ne, nw], axis=1))
    return Mesh(points, np.concatenate([first, second], axis=1).reshape(-1, 3))


def graded_interval(start: float, stop: float, cells: int, grading: float,
           ends: str = "both") -> np.ndarray:
    """Return ``cells + 1`` coordinates, denser towards ``ends`` ("start", "stop" or "both").

    ``grading`` is the exponent of the clustering, ≥ 1; 1 is uniform.
    """
    _check.integer("cells", cells, low=1)
    _check.number("grading", grading, low=1.0)
    s = np.linspace(0.0, 1.0, cells + 1)
    if ends == "both":
        s = np.where(s <= 0.5, 0.5 * (2 * s)**grading, 1.0 - 0.5 * (2 * (1 - s))**grading)
    elif ends == "start":
        s = s**grading
    elif ends == "stop":
        s = 1.0 - (1.0 - s)**grading
    else:
        raise ValueError(f"ends must be 'start', 'stop' or 'both', got {ends!r}")
    return start + (stop - start) * s


def graded_line(length: float, name: str, spans: np.ndarray, cells: int,
                grading: float) -> np.ndarray:
    """Return coordinates 0 … length (m), refined at both ends of each electrode's span on a pipe.

    Each electrode and each gap has ``cells`` cells; the sections before the first and after the
    last electrode have half of that. ``ValueError`` with the name of ``spans`` if they do not fit.
    """
    edges = _check.array(name, spans, (None, 2), units="m").ravel()
    if len(edges) == 0 or (np.diff([0.0, *edges, length]) <= 0).any():
        raise ValueError(f"{name} must increase, keep a gap between electrodes and lie inside the "
                         f"pipe, 0 … {length:g} m, got {spans!r}")
    half = max(1, cells // 2)
    lines = [graded_interval(0.0, edges[0], half, grading, "stop")]
    lines += [graded_interval(a, b, cells, grading) for a, b in itertools.pairwise(edges)]
    lines += [graded_interval(edges[-1], length, half, grading, "start")]
    return np.concatenate([line[:-1] for line in lines] + [[length]])


def graded_pipe_mesh(length: float, half_width: float, electrode_spans: np.ndarray,
                     cells_along: int, cells_across: int) -> Mesh:
    """Return an EIT mesh of [0, length] × [-half_width, half_width], fine at electrodes and walls.

    Parameters
    ----------
    length, half_width : float
        In m.
    electrode_spans : (n, 2) float
        Start and end (m) of each electrode along the wall, increasing and disjoint.
    cells_along : int
        Cells on each electrode and in each gap; before the first and after the last electrode half
        of that.
    cells_across : int
        Cells from wall to wall.
    """
    # exponents with the smallest voltage error for random slugs at equal numbers of unknowns
    x = graded_line(length, "electrode_spans", electrode_spans, cells_along, 2.5)
    return rectangle_mesh(x, graded_interval(-half_width, half_width, cells_across, 1.75))
