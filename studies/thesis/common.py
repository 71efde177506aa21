"""What the figures share: playing an episode, judging it, laying out truth beside estimates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from eitbench import scoring
from eitbench.bench.methods import load_method
from eitbench.bench.runner import iter_estimates
from eitbench.data.recordings import score_operators
from eitbench.envs.estimation import EstimationEnv
from eitbench.envs.rendering import SPREAD_MAP, colour_range, draw_electrodes, draw_field
from eitbench.numerics.mesh import Mesh
from eitbench.physics.transport import VelocityField
from eitbench.worlds.task import Estimate, Task

INK, TRUE, ACCENT = "#0b6e75", "0.35", "#d1495b"
"""Colours of curves: an estimate, the truth, a second estimate."""


def estimates_of(env: EstimationEnv, baseline: str, seed: int) -> list[Estimate]:
    """What a baseline says of t = 1 … T."""
    steps = iter_estimates(env, load_method(baseline, "estimation"), seed)
    with threadpool_limits(1):
        return [estimate for _, estimate in tqdm(steps, total=env.task.n_steps, desc=baseline,
                                                 unit="state", disable=None, leave=False)]


def error_of(env: EstimationEnv, estimates: list[Estimate]) -> float:
    """ẽ_c of the episode ``env`` has just played."""
    interpolation, mass = score_operators(env.world)
    scored = slice(env.task.warm_up, None)
    means = np.array([estimate.mean for estimate in estimates])
    return scoring.relative_error((interpolation @ means[scored].T).T, env.truth()[scored], mass)


def verdict(claim: str, holds: bool) -> str:
    """A line on what the thesis shows: whether our data show it too is computed, not written
    down."""
    return f"{'Agrees' if holds else 'DIFFERS'}: {claim}"


def milliseconds(env: EstimationEnv, t: int) -> str:
    return f"{1e3 * t * env.task.transport.time_step:.0f} ms"


def save(figure: Figure, path: Path) -> None:
    """Write a PNG, and its folder if need be."""
    path.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure)
    figure.savefig(path)


def idle_electrodes(axes: Axes, task: Task, width: float = 3) -> None:
    """All electrodes in grey: which of them inject is not the point."""
    draw_electrodes(axes, task, np.zeros(task.currents.shape[1]), width=width)


def pipe_grid(rows: int, columns: int, titles: list[str]) -> tuple[Figure, np.ndarray]:
    """Panels for pictures of the pipe, titles above the columns."""
    figure = Figure(figsize=(3.6 * columns, 0.95 * rows + 0.7), dpi=130, layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for column, title in enumerate(titles):
        axes[0, column].set_title(title, fontsize=10)
        axes[-1, column].set_xlabel("x / cm")
    return figure, axes


def shown_times(env: EstimationEnv, rows: int = 5) -> list[int]:
    """The states that pictures of the pipe show."""
    first = env.task.warm_up + 6
    return list(range(first, first + 5 * rows, 5))


def draw_fields(env: EstimationEnv, axes: np.ndarray, times: list[int],
                columns: Sequence[list[Estimate]]):
    """Truth in the first column of ``axes``, estimates beside it, one state a row; returns the
    mappable."""
    truth = env.truth()
    (low, high) = colour_range(env.task)
    for row, t in zip(axes, times, strict=True):
        fields = [(env.truth_mesh(), truth[t - 1])]
        fields += [(env.task.mesh, estimates[t - 1].mean) for estimates in columns]
        for ax, (mesh, values) in zip(row, fields, strict=True):
            mappable = draw_field(ax, mesh, values, low, high)
            idle_electrodes(ax, env.task)
            ax.label_outer()
        row[0].set_ylabel(f"{milliseconds(env, t)}\ny / cm", fontsize=9)
    return mappable


def comparison(path: Path, env: EstimationEnv, columns: dict[str, list[Estimate]]) -> None:
    """A figure of truth and estimates of the pipe over time, in one colour scale."""
    times = shown_times(env)
    figure, axes = pipe_grid(len(times), 1 + len(columns), ["truth", *columns])
    mappable = draw_fields(env, axes, times, list(columns.values()))
    figure.colorbar(mappable, ax=axes, label="concentration / (mol/m³)", extend="both", aspect=40)
    save(figure, path)


def draw_flow(axes: Axes, mesh: Mesh, flow: VelocityField,
              inside: Callable[[np.ndarray], np.ndarray], top: float):
    """Speed in colours up to ``top`` (m/s) and streamlines over it; returns the mappable, in cm/s.

    ``inside`` says of points (k, 2) in m whether a streamline may pass there.
    """
    mappable = draw_field(axes, mesh, 100 * np.hypot(*flow(mesh.points).T), 0.0, 100 * top,
                          SPREAD_MAP)
    low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
    x, y = (np.linspace(*ends, round((ends[1] - ends[0]) / 0.0035) + 1)
            for ends in zip(low, high, strict=True))
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    velocity = np.where(inside(points)[:, None], flow(points), np.nan).reshape(len(y), len(x), 2)
    axes.streamplot(100 * x, 100 * y, velocity[..., 0], velocity[..., 1], color="white",
                    linewidth=0.7, arrowsize=0.8,
                    density=np.array([0.9, 0.9]) * np.maximum((high - low) / 0.28, 0.7))
    return mappable


def bare(axes: Axes) -> None:
    """No frame above and to the right of a diagram."""
    axes.spines[["top", "right"]].set_visible(False)
