"""Pictures of an episode: fields on triangles, electrodes, the injected pair."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

from eitbench.physics.mesh import Mesh
from eitbench.task import Task

FIELD_MAP, SPREAD_MAP = "viridis", "magma"
SOURCE, SINK, IDLE = "#d1495b", "#2e86ab", "#5c5c5c"


def colour_range(task: Task) -> tuple[float, float]:
    """One colour scale (mol/m³) for truth and estimates of a task."""
    return 0.6 * task.expected_concentration, 1.8 * task.expected_concentration


def draw_field(axes: Axes, mesh: Mesh, values: np.ndarray, low: float, high: float, colours: str = FIELD_MAP):
    """Nodal ``values`` as smooth colours with equal aspect, axes in cm; returns the mappable for a colour bar."""
    triangles = Triangulation(100 * mesh.points[:, 0], 100 * mesh.points[:, 1], mesh.cells)
    mappable = axes.tripcolor(triangles, values, shading="gouraud", cmap=colours, vmin=low, vmax=high)
    axes.set_aspect("equal")
    axes.set(xlim=(triangles.x.min(), triangles.x.max()), ylim=(triangles.y.min(), triangles.y.max()), ylabel="y / cm")
    return mappable


def draw_electrodes(axes: Axes, task: Task, currents: np.ndarray, width: float = 5.0) -> None:
    """Electrodes as bars on the wall: the source red, the sink blue, the others grey."""
    cem = task.observation.cem
    for facets, current in zip(cem.electrodes, currents, strict=True):
        colour = IDLE if current == 0 else SOURCE if current > 0 else SINK
        axes.add_collection(LineCollection(list(100 * cem.mesh.points[facets]), colors=colour, linewidths=width,
                                           antialiased=False, clip_on=False, zorder=3))


def draw_frame(task: Task, truth_mesh: Mesh, truth: np.ndarray, estimate: np.ndarray, spread: np.ndarray | None,
               currents: np.ndarray, time: float) -> np.ndarray:
    """(height, width, 3) uint8 picture: truth and estimate in one colour scale, the estimate's spread, electrodes.

    Parameters
    ----------
    task : Task
    truth_mesh, truth : Mesh, (n_truth,)
    estimate : (n,) in mol/m³ on ``task.mesh``
    spread : (n,) standard deviation in mol/m³, or None: not claimed
    currents : (L,) A
    time : float, s
    """
    low, high = colour_range(task)
    spread_high = 0.25 * task.expected_concentration
    figure = Figure(figsize=(8.0, 6.4), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    top, middle, bottom = figure.subplots(3, 1, sharex=True)
    draw_field(top, truth_mesh, truth, low, high)
    field = draw_field(middle, task.mesh, estimate, low, high)
    figure.colorbar(field, ax=[top, middle], label="concentration / (mol/m³)", extend="both", aspect=30)
    if spread is None:
        bottom.text(0.5, 0.5, "no spread claimed", transform=bottom.transAxes, ha="center", va="center")
        draw = draw_field(bottom, task.mesh, np.zeros(task.mesh.n_nodes), 0.0, spread_high, "Greys")
    else:
        draw = draw_field(bottom, task.mesh, spread, 0.0, spread_high, SPREAD_MAP)
        figure.colorbar(draw, ax=bottom, label="std / (mol/m³)", extend="max", aspect=12)
    for axes, title in ((top, f"truth, t = {1e3 * time:.0f} ms"), (middle, "estimate"),
                        (bottom, "standard deviation of the estimate")):
        axes.set_title(title, loc="left", fontsize=10)
        draw_electrodes(axes, task, currents)
    bottom.set_xlabel("x / cm    (flow →;   current enters at the red electrode and leaves at the blue one)")
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
