"""Shared parts of the figures: run a baseline, score it, draw ground truth next to estimates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from eitbench import scoring
from eitbench.bench.methods import load_method
from eitbench.bench.runner import iter_estimates
from eitbench.data.episode_cache import score_operators, truth_mesh
from eitbench.envs.estimation import EstimationEnv
from eitbench.envs.rendering import STD_COLORMAP, colour_range, draw_electrodes, draw_field
from eitbench.numerics.mesh import Mesh
from eitbench.physics.transport import VelocityField
from eitbench.worlds.task import Estimate, Task

INK, GREY, ACCENT = "#0b6e75", "0.35", "#d1495b"
"""Colours of curves: an estimate, the ground truth, a second estimate."""


def run_baseline(env: EstimationEnv, baseline: str, seed: int) -> list[Estimate]:
    """Return the estimates of a baseline for t = 1 … T."""
    steps = iter_estimates(env, load_method(baseline, "estimation"), seed)
    with threadpool_limits(1):
        return [estimate for _, estimate in tqdm(steps, total=env.task.n_steps, desc=baseline,
                                                 unit="state", disable=None, leave=False)]


def episode_error(env: EstimationEnv, estimates: list[Estimate]) -> float:
    """Return ẽ_c of the last episode of ``env``."""
    interpolation, mass = score_operators(env.world)
    scored = slice(env.task.warm_up, None)
    means = np.array([estimate.mean for estimate in estimates])
    return scoring.relative_error((interpolation @ means[scored].T).T, env.truth()[scored], mass)


def run_parallel(function: Callable[..., Any], cases: Sequence[tuple[Any, ...]], jobs: int,
                 description: str) -> list[Any]:
    """Return ``function(*case)`` for each case, computed in ``jobs`` processes."""
    with Parallel(n_jobs=jobs, return_as="generator", batch_size=1, pre_dispatch=jobs) as parallel:
        results = parallel(delayed(function)(*case) for case in cases)
        return list(tqdm(results, total=len(cases), desc=description, disable=None))


def agreement_line(statement: str, holds: bool) -> str:
    """Return a line on a statement of the thesis; ``holds`` is computed from the data."""
    return f"{'Agrees' if holds else 'DIFFERS'}: {statement}"


def format_milliseconds(env: EstimationEnv, t: int) -> str:
    """Return the time of state t."""
    return f"{1e3 * t * env.task.transport.time_step:.0f} ms"


def save_figure(figure: Figure, path: Path) -> None:
    """Write a PNG; create its folder if missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure)
    figure.savefig(path)


def draw_idle_electrodes(axes: Axes, task: Task, width: float = 3) -> None:
    """Draw all electrodes in grey, without the active injection."""
    draw_electrodes(axes, task, np.zeros(task.currents.shape[1]), width=width)


def make_pipe_grid(rows: int, columns: int, titles: list[str]) -> tuple[Figure, np.ndarray]:
    """Create panels for pictures of the pipe, with titles above the columns."""
    figure = Figure(figsize=(3.6 * columns, 0.95 * rows + 0.7), dpi=130, layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for column, title in enumerate(titles):
        axes[0, column].set_title(title, fontsize=10)
        axes[-1, column].set_xlabel("x / cm")
    return figure, axes


def snapshot_times(env: EstimationEnv, rows: int = 5) -> list[int]:
    """Return the states that pictures of the pipe show."""
    first = env.task.warm_up + 6
    return list(range(first, first + 5 * rows, 5))


def draw_fields(env: EstimationEnv, axes: np.ndarray, times: list[int],
                columns: Sequence[list[Estimate]]):
    """Draw ground truth in the first column of ``axes`` and estimates in the others, one state per
    row; return the mappable."""
    truth = env.truth()
    (low, high) = colour_range(env.task)
    for row, t in zip(axes, times, strict=True):
        fields = [(truth_mesh(env.world), truth[t - 1])]
        fields += [(env.task.mesh, estimates[t - 1].mean) for estimates in columns]
        for ax, (mesh, values) in zip(row, fields, strict=True):
            mappable = draw_field(ax, mesh, values, low, high)
            draw_idle_electrodes(ax, env.task)
            ax.label_outer()
        row[0].set_ylabel(f"{format_milliseconds(env, t)}\ny / cm", fontsize=9)
    return mappable


def draw_comparison(path: Path, env: EstimationEnv, columns: dict[str, list[Estimate]]) -> None:
    """Draw ground truth and estimates of the pipe over time in one colour scale."""
    times = snapshot_times(env)
    figure, axes = make_pipe_grid(len(times), 1 + len(columns), ["truth", *columns])
    mappable = draw_fields(env, axes, times, list(columns.values()))
    figure.colorbar(mappable, ax=axes, label="concentration / (mol/m³)", extend="both", aspect=40)
    save_figure(figure, path)


def draw_flow(axes: Axes, mesh: Mesh, flow: VelocityField,
              inside: Callable[[np.ndarray], np.ndarray], top: float):
    """Draw the speed in colours up to ``top`` (m/s) and streamlines; return the mappable, in cm/s.

    ``inside`` maps points (k, 2) in m to True where streamlines may pass.
    """
    mappable = draw_field(axes, mesh, 100 * np.hypot(*flow(mesh.points).T), 0.0, 100 * top,
                          STD_COLORMAP)
    low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
    x, y = (np.linspace(*ends, round((ends[1] - ends[0]) / 0.0035) + 1)
            for ends in zip(low, high, strict=True))
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    velocity = np.where(inside(points)[:, None], flow(points), np.nan).reshape(len(y), len(x), 2)
    axes.streamplot(100 * x, 100 * y, velocity[..., 0], velocity[..., 1], color="white",
                    linewidth=0.7, arrowsize=0.8,
                    density=np.array([0.9, 0.9]) * np.maximum((high - low) / 0.28, 0.7))
    return mappable


def despine(axes: Axes) -> None:
    """Remove the upper and right spine of a diagram."""
    axes.spines[["top", "right"]].set_visible(False)
