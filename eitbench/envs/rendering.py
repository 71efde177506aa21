"""Images of an episode: fields on triangles, isosurfaces in tetrahedra, electrodes, the injected
pair."""

from __future__ import annotations

from functools import lru_cache
from textwrap import fill
from typing import Any

import numpy as np
import scipy.sparse as sp
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba_array
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

from eitbench.numerics.mesh import Mesh, rectangle_mesh
from eitbench.worlds.task import Task

FIELD_COLORMAP, STD_COLORMAP = "viridis", "magma"
SOURCE, SINK, IDLE = "#d1495b", "#2e86ab", "#5c5c5c"
HIGH_COLOUR, LOW_COLOUR = "#e08e0b", "#2f6db5"
_EYE = -np.linalg.qr(np.array([[0.30, 0.0, 1.0], [0.22, 1.0, 0.0], [0.9, -0.3, -0.3]]).T)[0].T
"""Rows: directions to the right, up and to the viewer; the pipe's axis z runs to the right."""


def colour_range(task: Task) -> tuple[float, float]:
    """Return the colour scale (mol/m³) that truth and estimates of a task share."""
    return 0.6 * task.expected_concentration, 1.8 * task.expected_concentration


def draw_field(axes: Axes, mesh: Mesh, values: np.ndarray, low: float, high: float,
               colours: str = FIELD_COLORMAP):
    """Draw nodal ``values`` as smooth colours, axes in cm, in 3D on the slice x = 0 with z to the
    right; return the mappable for a colour bar."""
    if mesh.dim == 3:
        mesh, onto = _slice(mesh)
        values = onto @ values
    x, y = 100 * mesh.points.T
    mappable = axes.tripcolor(Triangulation(x, y, mesh.cells), values, shading="gouraud",
                              cmap=colours, vmin=low, vmax=high)
    axes.set_aspect("equal")
    axes.set(xlim=(x.min(), x.max()), ylim=(y.min(), y.max()), ylabel="y / cm")
    return mappable


@lru_cache(maxsize=8)
def _slice(mesh: Mesh) -> tuple[Mesh, sp.csr_array]:
    """Return the slice x = 0 of a pipe along z as a mesh in (z, y), and the interpolation to it."""
    (_, low, begin), (_, high, end) = mesh.points.min(axis=0), mesh.points.max(axis=0)
    flat = rectangle_mesh(np.linspace(begin, end, 161), np.linspace(low, high, 41))
    z, y = flat.points.T
    return flat, mesh.interpolation_to(np.column_stack([np.zeros(flat.n_nodes), y, z]))


def draw_electrodes(axes: Axes, task: Task, currents: np.ndarray, width: float = 5.0) -> None:
    """Draw electrodes as bars on the wall, in 3D at the slice: source red, sink blue, idle grey."""
    cem = task.observation.cem
    for facets, current in zip(cem.electrodes, currents, strict=True):
        colour = IDLE if current == 0 else SOURCE if current > 0 else SINK
        bars = 100 * cem.mesh.points[facets][..., :task.mesh.dim]
        if task.mesh.dim == 3:
            x, y, z = bars.reshape(-1, 3).T
            if x.min() > -1e-6 or x.max() < 1e-6:
                continue
            furthest = y[np.abs(y).argmax()]
            bars = np.array([[[z.min(), furthest], [z.max(), furthest]]])
        axes.add_collection(LineCollection(list(bars), colors=colour, linewidths=width,
                                           antialiased=False, clip_on=False, zorder=3))


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
        _draw_triangles(axes, np.concatenate(surfaces), colours)
    _outline(axes, mesh)


def _draw_triangles(axes: Axes, triangles: np.ndarray, colours: np.ndarray) -> None:
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


def draw_frame(task: Task, fields: list[tuple[str, Mesh, np.ndarray]], currents: np.ndarray,
               time: float, spread: tuple[str, np.ndarray | None] | None = None,
               region: tuple[float, float] | None = None) -> np.ndarray:
    """(height, width, 3) uint8: fields in one colour scale, and electrodes, at one time in s.

    Panels of pipes are below each other, in 3D with the slice x = 0; panels of tanks are in a row.

    Parameters
    ----------
    task : Task
    fields : list of (title, mesh, (n,) in mol/m³ on the mesh)
    currents : (L,) A
    time : float, s
    spread : (title, (n,) in mol/m³ on ``task.mesh``, or None if unknown), optional
        Standard deviation of the last field, for another panel; in 3D isosurfaces of the fields are
        added too.
    region : (float, float), optional
        Ends in m along a 2D pipe of the region of interest, drawn as lines.
    """
    tank = task.vessel is not None and not task.vessel.is_elongated
    in_space = task.mesh.dim == 3 and spread is not None
    count = len(fields) + (spread is not None)
    figure = Figure((3.0 * count, 3.6) if tank else (7.2 + 3.6 * in_space, 1.85 * count + 0.5),
                    dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    grid = figure.subplots(*((1, count) if tank else (count, 1 + in_space)), squeeze=False)
    panels = list(grid[0] if tank else grid[:, 0])
    size = 10 if tank else 11
    bar: dict[str, Any] = {"location": "bottom", "aspect": 50, "shrink": 0.8}
    for axes, (title, mesh, values) in zip(panels, fields, strict=False):
        mappable = draw_field(axes, mesh, values, *colour_range(task))
        axes.set_title(fill(title, 34 if tank else 80), loc="left", fontsize=size)
    figure.colorbar(mappable, ax=panels, extend="both", **bar,
                    label=f"concentration / (mol/m³) after {1e3 * time:.0f} ms")
    if spread is not None:
        title, std = spread
        shown = np.zeros(task.mesh.n_nodes) if std is None else std
        high = max(0.25, task.prior.initial_std) * task.expected_concentration
        mappable = draw_field(panels[-1], task.mesh, shown, 0.0, high,
                              "Greys" if std is None else STD_COLORMAP)        # zero is white
        panels[-1].set_title(fill(title, 28 if tank else 80), loc="left", fontsize=size)
        figure.colorbar(mappable, ax=panels, extend="max", label="std / (mol/m³)", **bar)
        figure.suptitle("current enters at the red electrode and leaves at the blue one",
                        fontsize=size)
    if in_space:
        levels = 1.08 * task.expected_concentration, 1.36 * task.expected_concentration
        for axes, (_, mesh, values) in zip(grid[:, 1], fields, strict=False):
            draw_isosurfaces(axes, mesh, values, *levels)
            axes.set_title("{:.0f} (blue) and {:.0f} (orange) mol/m³".format(*levels),
                           fontsize=size)
        grid[-1, 1].set_axis_off()
    for axes in panels:
        axes.set(xticks=(), yticks=(), ylabel="")
        draw_electrodes(axes, task, currents)
        for end in region or ():
            axes.axvline(100 * end, color="white", linewidth=1.0, linestyle="--")
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
