"""Images of an episode: fields on triangles, electrodes, the injected pair."""

from __future__ import annotations

from functools import lru_cache
from textwrap import fill

import numpy as np
import scipy.sparse as sp
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

from eitbench.numerics.mesh import Mesh, rectangle_mesh
from eitbench.worlds.task import Task

FIELD_COLORMAP, STD_COLORMAP = "viridis", "magma"
SOURCE, SINK, IDLE = "#d1495b", "#2e86ab", "#5c5c5c"


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
        bars = 100 * cem.mesh.points[facets]
        if cem.mesh.dim == 3:
            x, y, z = bars.reshape(-1, 3).T
            if x.min() > -1e-6 or x.max() < 1e-6:
                continue
            furthest = y[np.abs(y).argmax()]
            bars = np.array([[[z.min(), furthest], [z.max(), furthest]]])
        axes.add_collection(LineCollection(list(bars), colors=colour, linewidths=width,
                                           antialiased=False, clip_on=False, zorder=3))


def draw_frame(task: Task, truth_mesh: Mesh, truth: np.ndarray, estimate: np.ndarray,
               spread: np.ndarray | None, currents: np.ndarray, time: float,
               region: tuple[float, float] | None = None) -> np.ndarray:
    """(height, width, 3) uint8: truth and estimate in one colour scale, its standard deviation and
    electrodes; panels of pipes are below each other, in 3D with isosurfaces, of tanks in a row.

    Parameters
    ----------
    task : Task
    truth_mesh, truth : Mesh, (n_truth,)
    estimate : (n,) in mol/m³ on ``task.mesh``
    spread : (n,) standard deviation in mol/m³, or None if it is unknown
    currents : (L,) A
    time : float, s
    region : (float, float), optional
        Ends in m along a 2D pipe of the region of interest, drawn as lines.
    """
    low, high = colour_range(task)
    spread_high = max(0.25, task.prior.initial_std) * task.expected_concentration
    solid = task.mesh.dim == 3
    tank = _is_tank(task)
    figure = _figure((12.0, 4.4) if tank else (12.0, 6.4) if solid else (8.0, 6.4))
    grid = figure.add_gridspec(1, 3) if tank else figure.add_gridspec(3, 2 if solid else 1)
    first = figure.add_subplot(grid[0, 0])
    places = [grid[0, k] if tank else grid[k, 0] for k in (1, 2)]
    panels = [first, *(figure.add_subplot(place, sharex=first, sharey=first) for place in places)]
    draw_field(panels[0], truth_mesh, truth, low, high)
    field = draw_field(panels[1], task.mesh, estimate, low, high)
    where = {"location": "bottom", "aspect": 40} if tank else {"aspect": 30}
    figure.colorbar(field, ax=panels[:2], label="concentration / (mol/m³)", extend="both", **where)
    if spread is None:
        panels[2].text(0.5, 0.5, "no reported uncertainty", transform=panels[2].transAxes,
                       ha="center", va="center")
    shown = np.zeros(task.mesh.n_nodes) if spread is None else spread
    colours, label = ("Greys", "") if spread is None else (STD_COLORMAP, "std / (mol/m³)")
    draw = draw_field(panels[2], task.mesh, shown, 0.0, spread_high, colours)
    if spread is not None or tank:                       # panels of tanks keep their size
        where = {"location": "bottom", "aspect": 20} if tank else {"aspect": 12}
        bar = figure.colorbar(draw, ax=panels[2], label=label, extend="max", **where)
        if spread is None:                                # an invisible bar keeps its space
            for part in bar.ax.findobj():
                part.set_alpha(0.0)
    titles = (f"truth, t = {1e3 * time:.0f} ms", "estimate", "standard deviation of the estimate")
    for axes, title in zip(panels, titles, strict=True):
        axes.set_title(title, loc="left", fontsize=10)
        draw_electrodes(axes, task, currents)
        for end in region or ():
            axes.axvline(100 * end, color="white", linewidth=1.0, linestyle="--")
    current = "current enters at the red electrode and leaves at the blue one"
    if tank:
        for axes in panels:
            axes.set_xlabel("x / cm")
        figure.suptitle(current, fontsize=10)
    else:
        panels[2].set_xlabel(f"{'z' if solid else 'x'} / cm    (flow →;   {current})")
    if solid:
        from eitbench.envs.isosurface import draw_electrodes_in_space, draw_isosurfaces
        low, high = 1.08 * task.expected_concentration, 1.36 * task.expected_concentration
        for row, (mesh, values) in enumerate([(truth_mesh, truth), (task.mesh, estimate)]):
            axes = figure.add_subplot(grid[row, 1])
            draw_isosurfaces(axes, mesh, values, low, high)
            axes.set_title(f"{low:.0f} (blue) and {high:.0f} (orange) mol/m³", fontsize=10)
        draw_electrodes_in_space(figure.add_subplot(grid[2, 1]), task.observation.cem, currents,
                                 (SOURCE, SINK, IDLE))
    return _pixels(figure)


def draw_comparison(task: Task, fields: list[tuple[str, Mesh, np.ndarray]], currents: np.ndarray,
                    time: float) -> np.ndarray:
    """(height, width, 3) uint8: titled ``fields`` (title, mesh, (n,) in mol/m³ on the mesh) at one
    time in s, in one colour scale, with currents (L,) in A; panels as in `draw_frame`."""
    tank = _is_tank(task)
    figure = _figure((3.0 * len(fields), 3.6) if tank else (7.2, 1.85 * len(fields) + 0.5))
    panels = figure.subplots(*((1, len(fields)) if tank else (len(fields), 1)), squeeze=False).flat
    for axes, (title, mesh, values) in zip(panels, fields, strict=True):
        mappable = draw_field(axes, mesh, values, *colour_range(task))
        axes.set_title(fill(title, 34 if tank else 80), loc="left", fontsize=10 if tank else 11)
        axes.set(xticks=(), yticks=(), ylabel="")
        draw_electrodes(axes, task, currents)
    figure.colorbar(mappable, ax=list(figure.axes), location="bottom", aspect=50, shrink=0.8,
                    extend="both", label=f"concentration / (mol/m³) after {1e3 * time:.0f} ms")
    return _pixels(figure)


def _is_tank(task: Task) -> bool:
    return task.vessel is not None and not task.vessel.is_elongated


def _figure(size: tuple[float, float]) -> Figure:
    figure = Figure(figsize=size, dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _pixels(figure: Figure) -> np.ndarray:
    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
