"""Meshes of round cross-sections, and prisms on any cross-section cut into tetrahedra.

A section is in the plane (x, y). The axis of a 3D pipe, along which the fluid flows, is the third
coordinate z; the plane channel of `eitbench.numerics.mesh` has its flow along x.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from eitbench import _check
from eitbench.numerics.mesh import Mesh, check_increasing, graded_interval, graded_line

TWO_PI = 2.0 * np.pi


def disc_mesh(radii: Sequence[float] | np.ndarray, angles: Sequence[np.ndarray]) -> Mesh:
    """Return a triangle mesh of a disc, with nodes at the centre (0) and on rings, outwards.

    Rings may have different numbers of nodes. Each edge of a ring forms a triangle with the node of
    the neighbouring ring whose sector contains the middle of the edge; the sector of a node extends
    to the middles of its two edges. ``ValueError`` naming the argument if a shape or an order is
    wrong, or if neighbouring rings differ so much that triangles overlap.

    Parameters
    ----------
    radii : (K,) float
        Radius of each ring in m, > 0 and increasing; the last one is the wall, a polygon.
    angles : K sequences of (n_k ≥ 3,) float
        Angles of each ring's nodes in rad, increasing and within one turn.
    """
    radii = _check.array("radii", radii, (None,), units="m", positive=True)
    if len(radii) == 0 or (np.diff(radii) <= 0).any():
        raise ValueError("radii must hold at least one radius in m, strictly increasing, "
                         f"got {radii!r}")
    if len(angles) != len(radii):
        raise ValueError(f"angles must hold one sequence for each of the {len(radii)} radii, "
                         f"got {len(angles)}")
    rings = [_check.array(f"angles[{k}]", ring, (None,), units="rad")
             for k, ring in enumerate(angles)]
    for k, ring in enumerate(rings):
        if len(ring) < 3 or (np.diff(ring) <= 0).any() or ring[-1] >= ring[0] + TWO_PI:
            raise ValueError(f"angles[{k}] must hold at least three angles in rad, strictly "
                             f"increasing and within one turn, got {ring!r}")
    polar = [r * np.stack([np.cos(ring), np.sin(ring)], axis=1)
             for r, ring in zip(radii, rings, strict=True)]
    points = np.concatenate([np.zeros((1, 2)), *polar])
    first = 1 + np.cumsum([0, *map(len, rings)])
    here = np.arange(len(rings[0]))
    cells = [np.stack([np.zeros_like(here), 1 + here, 1 + (here + 1) % len(here)], axis=1)]
    cells += [_between(inner, outer, first[k], first[k + 1])
              for k, (inner, outer) in enumerate(itertools.pairwise(rings))]
    triangles = np.concatenate(cells)
    # All are counter-clockwise, so that an area is negative only if some overlap.
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    if area.min() <= 0:
        raise ValueError("angles must be dense, and similar on neighbouring rings, so that no "
                         "triangle is turned over; got one at node "
                         f"{triangles[area.argmin()].max()}")
    return Mesh(points, triangles)


def _between(inner: np.ndarray, outer: np.ndarray, first_inner: int,
             first_outer: int) -> np.ndarray:
    """Return triangles (n_inner + n_outer, 3), counter-clockwise, between rings of these angles."""
    i = np.arange(len(inner))
    j = np.arange(len(outer))
    middle_i, middle_j = (np.mod(0.5 * (ring + np.append(ring[1:], ring[0] + TWO_PI)), TWO_PI)
                          for ring in (inner, outer))
    # All edges are sorted by angle; where two midpoints coincide the inner edge comes first.
    on_outer = first_outer + _node_at(middle_j, middle_i, "left")
    on_inner = first_inner + _node_at(middle_i, middle_j, "right")
    inwards = np.stack([first_inner + i, on_outer, first_inner + (i + 1) % len(i)], axis=1)
    outwards = np.stack([first_outer + j, first_outer + (j + 1) % len(j), on_inner], axis=1)
    return np.concatenate([inwards, outwards])


def _node_at(middles: np.ndarray, angle: np.ndarray, side: str) -> np.ndarray:
    """Return the node after the last edge with its midpoint < ``angle`` ("left") or ≤ ``angle``."""
    order = np.argsort(middles)
    before = order[np.searchsorted(middles[order], angle, side) - 1]  # type: ignore[call-overload]
    return (before + 1) % len(middles)


def uniform_disc(radius: float, rings: int) -> Mesh:
    """Return a uniform disc of ``radius`` (m): 6k nodes on ring k, 1 + 3·rings·(rings+1) in all."""
    _check.number("radius", radius, low=0.0, open_low=True, units="m")
    _check.integer("rings", rings, low=1)
    number = np.arange(1, rings + 1)
    return disc_mesh(radius * number / rings, [TWO_PI * np.arange(n) / n for n in 6 * number])


def electrode_disc(radius: float, spans: np.ndarray, cells_at_electrodes: int, rings: int,
                   grading: tuple[float, float] = (2.0, 1.5)) -> Mesh:
    """Return an EIT mesh of a disc, refined at the electrode edges and the wall.

    Inner rings have fewer nodes, with a spacing similar to the distance of the rings and more
    uniform than on outer rings. ``ValueError`` naming the argument if it is out of range, of the
    wrong shape, or if electrodes touch or overlap; also if the wall has cells so long that they
    intersect the rings next to it.

    Parameters
    ----------
    radius : float
        In m.
    spans : (L, 2) float
        First and last angle (rad) of each electrode, increasing, disjoint and within one turn.
    cells_at_electrodes : int
        Cells on each electrode and in each gap between two.
    rings : int
        Cells from the centre to the wall.
    grading : (float, float)
        Exponents of the clustering towards the electrode edges and towards the wall, see
        `graded_interval`; with 16 electrodes the default is within a few per cent of the smallest
        voltage error at equal numbers of unknowns. Angles stay above 15° where the wall's cells are
        about as long as the rings next to them are wide.
    """
    _check.number("radius", radius, low=0.0, open_low=True, units="m")
    _check.integer("cells_at_electrodes", cells_at_electrodes, low=1)
    _check.integer("rings", rings, low=1)
    around, across = grading
    edges = _check.array("spans", spans, (None, 2), units="rad").ravel()
    closed = [*edges, *(edges[:1] + TWO_PI)]
    if len(edges) == 0 or (np.diff(closed) <= 0).any():
        raise ValueError("spans must hold at least one electrode, increase, keep a gap between "
                         f"electrodes and lie within one turn, got {spans!r}")
    lines = [graded_interval(a, b, cells_at_electrodes, around)
             for a, b in itertools.pairwise(closed)]
    wall = np.concatenate([line[:-1] for line in lines])
    radii = graded_interval(0.0, radius, rings, across, "stop")
    angles = [wall]
    for r, step in zip(radii[-2:0:-1], np.diff(radii)[-2::-1], strict=True):
        count = min(len(angles[-1]), max(6, round(TWO_PI * r / step)))
        part = np.linspace(0.0, 1.0, count, endpoint=False)
        evenly = wall[0] + TWO_PI * part
        crowded = np.interp(part * len(wall), np.arange(len(wall) + 1), [*wall, wall[0] + TWO_PI])
        angles.append(evenly + (r / radius)**4 * (crowded - evenly))
    return disc_mesh(radii[1:], angles[::-1])


def extrude(section: Mesh, z: Sequence[float] | np.ndarray) -> Mesh:
    """Return tetrahedra of the body with this section in (x, y) at all ``z`` (m, increasing).

    Nodes are numbered by cross-section: all of the first ``z`` as in the section, then of the
    second, and so on. Every triangle and two neighbouring ``z`` bound a prism of three tetrahedra.
    On a prism's side the diagonal leads up from the lower node number to the higher one, so that
    neighbouring prisms share it; in every other layer it leads down, so that the mesh is symmetric
    in z. ``ValueError`` if ``section`` is not a mesh in 2D, or ``z`` does not increase.
    """
    z = check_increasing("z", z)
    if section.dim != 2:
        raise ValueError(f"section must be a mesh of triangles, got one in {section.dim}D")
    n = section.n_nodes
    sections = np.tile(section.points, (len(z), 1))
    points = np.concatenate([sections, np.repeat(z, n)[:, None]], axis=1)
    a, b, c = np.sort(section.cells, axis=1).T
    layer = np.arange(len(z) - 1)[:, None]
    # the layer in which diagonals start
    start, stop = n * (layer + layer % 2), n * (layer + 1 - layer % 2)
    cells = [np.stack(np.broadcast_arrays(*corners), axis=-1).reshape(-1, 4) for corners in (
        (start + a, start + b, start + c, stop + c), (start + a, start + b, stop + b, stop + c),
        (start + a, stop + a, stop + b, stop + c))]
    return Mesh(points, np.stack(cells, axis=1).reshape(-1, 4))


def round_pipe_mesh(length: float, radius: float, spans_around: np.ndarray,
                    spans_along: np.ndarray, cells_at_electrodes: tuple[int, int], rings: int,
                    grading: tuple[float, float, float] = (2.0, 1.5, 2.0)) -> Mesh:
    """Return an EIT mesh of a round pipe 0 ≤ z ≤ length, electrodes at all pairs of spans.

    ``ValueError`` naming the argument if it is out of range, of the wrong shape, or if electrodes
    touch or overlap.

    Parameters
    ----------
    length, radius : float
        In m.
    spans_around : (n, 2) float
        First and last angle (rad) of the electrodes of one ring, as in `electrode_disc`.
    spans_along : (m, 2) float
        Start and end (m) of each ring of electrodes, increasing and disjoint.
    cells_at_electrodes : (int, int)
        Cells on each electrode and in each gap, around and along the pipe; before the first and
        after the last ring half of that.
    rings : int
        Cells from the axis to the wall.
    grading : (float, float, float)
        Exponents of the refinement around, across and along the pipe, see `graded_interval`.
    """
    _check.number("length", length, low=0.0, open_low=True, units="m")
    around, along = cells_at_electrodes
    _check.integer("cells_at_electrodes[1]", along, low=1)
    z = graded_line(length, "spans_along", spans_along, along, grading[2])
    return extrude(electrode_disc(radius, spans_around, around, rings, grading[:2]), z)
