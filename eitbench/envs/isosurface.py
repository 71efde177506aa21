"""Surfaces of equal concentration in a mesh of tetrahedra, and their projection to an image."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgba_array

from eitbench.numerics.mesh import Mesh

HIGH_COLOUR, LOW_COLOUR = "#e08e0b", "#2f6db5"
_EYE = -np.linalg.qr(np.array([[0.30, 0.0, 1.0], [0.22, 1.0, 0.0], [0.9, -0.3, -0.3]]).T)[0].T
"""Rows: directions to the right, up and to the viewer; the pipe's axis z runs to the right."""


def isosurface(mesh: Mesh, values: np.ndarray, level: float) -> np.ndarray:
    """Return triangles (k, 3, 3), corners in m, on which interpolated ``values`` are ``level``.

    A tetrahedron with one corner on either side of the level is cut in a triangle, a tetrahedron
    with two in a quadrilateral, given as two triangles.
    """
    above = values > level
    # corners above the level first
    order = np.argsort(~above[mesh.cells], axis=1, kind="stable")
    cells = np.take_along_axis(mesh.cells, order, axis=1)
    count = above[mesh.cells].sum(axis=1)

    def crossing(corners: np.ndarray, i: int, j: int) -> np.ndarray:
        a, b = corners[:, i], corners[:, j]
        share = (level - values[a]) / (values[b] - values[a])
        return mesh.points[a] + share[:, None] * (mesh.points[b] - mesh.points[a])

    one, two, three = (cells[count == k] for k in (1, 2, 3))
    triangles = [np.stack([crossing(one, 0, j) for j in (1, 2, 3)], axis=1),
                 np.stack([crossing(three, i, 3) for i in (0, 1, 2)], axis=1)]
    corner = [crossing(two, i, j) for i, j in ((0, 2), (0, 3), (1, 3), (1, 2))]
    triangles += [np.stack([corner[i] for i in half], axis=1) for half in ((0, 1, 2), (0, 2, 3))]
    return np.concatenate(triangles)


def draw_isosurfaces(axes: Axes, mesh: Mesh, values: np.ndarray, low: float, high: float) -> None:
    """Draw the surfaces of ``low`` (blue) and ``high`` (orange) mol/m³ in the pipe's outline."""
    surfaces = [isosurface(mesh, values, level) for level in (low, high)]
    colours = np.repeat([LOW_COLOUR, HIGH_COLOUR], list(map(len, surfaces)))
    if len(colours):
        _draw(axes, np.concatenate(surfaces), colours)
    _outline(axes, mesh)


def _draw(axes: Axes, triangles: np.ndarray, colours: np.ndarray) -> None:
    """Draw triangles (k, 3, 3) in m projected by `_EYE`, the furthest first, with shading."""
    seen = 100.0 * triangles @ _EYE.T
    normal = np.cross(seen[:, 1] - seen[:, 0], seen[:, 2] - seen[:, 0])
    facing = np.abs(normal[:, 2]) / np.maximum(np.linalg.norm(normal, axis=1), 1e-300)
    shaded = to_rgba_array(colours.tolist(), 0.5)
    shaded[:, :3] *= (0.55 + 0.45 * facing)[:, None]
    order = np.argsort(seen[:, :, 2].mean(axis=1))
    axes.add_collection(PolyCollection(list(seen[order, :, :2]), facecolors=shaded[order],
                                       edgecolors="none"))


def _outline(axes: Axes, mesh: Mesh) -> None:
    """Draw both ends of the pipe and two lines between them."""
    low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
    angle = np.linspace(0.0, 2.0 * np.pi, 61)
    radius = 0.5 * (high - low)[0]
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    ends = [100.0 * np.stack([x, y, np.full_like(angle, z)], axis=1) @ _EYE.T
            for z in (low[2], high[2])]
    for end in ends:
        axes.plot(end[:, 0], end[:, 1], color="0.5", linewidth=0.8)
    for place in (ends[0][:, 1].argmax(), ends[0][:, 1].argmin()):
        axes.plot(*np.stack([end[place, :2] for end in ends], axis=1), color="0.5", linewidth=0.8)
    axes.set_aspect("equal")
    axes.set_axis_off()
