"""One self-contained HTML page of results: tables, charts, pictures, failures, and sweeps. Failures
are errors of a method in episodes of a run."""

from __future__ import annotations

import json
import textwrap
import warnings
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eitbench import _check
from eitbench._files import write_atomically
from eitbench._sanitize import sanitize
from eitbench.bench import tracks
from eitbench.bench.records import group_by, group_runs
from eitbench.bench.run import Job
from eitbench.bench.store import EpisodeStore
from eitbench.bench.text import scores_by_seed
from eitbench.bench.tracks import Environment
from eitbench.data.episode_cache import truth_mesh
from eitbench.data.episodes import simulate
from eitbench.data.seeds import format_seed, parse_seeds, seed_ranges
from eitbench.envs.rendering import FIELD_COLORMAP, colour_range, draw_field
from eitbench.numerics.mesh import Mesh
from eitbench.report import tables
from eitbench.report.boards import Leaderboard, restrict
from eitbench.report.sweep import Sweep
from eitbench.report.templates import data_uri, figure_image, render_template
from eitbench.worlds.task import Task

N_SNAPSHOT_METHODS, N_SNAPSHOT_TIMES = 3, 4
"""Methods and states in the pictures of an episode."""


class Failure(NamedTuple):
    """One error of a method in some episodes of a record."""

    record: dict[str, Any]
    seeds: list[str]
    message: str
    traceback: str
    """Lines of the method's own code; empty if the error was raised elsewhere."""

    def __str__(self) -> str:
        environment = self.record["environment"]["id"]
        where = f"{self.record['method']} in {environment} on {seed_ranges(self.seeds)}"
        return f"failed: {where}: {sanitize(self.message)}" + (
            "\n" + textwrap.indent(self.traceback.rstrip(), "  ") if self.traceback else "")


def select_requested(records: Iterable[dict[str, Any]], jobs: Iterable[Job],
                     ) -> list[dict[str, Any]]:
    """Return the records restricted to the episodes of these jobs."""
    asked = {(job.environment.name, job.load().name, format_seed(job.seed)) for job in jobs}
    found = (restrict(record, [seed for seed in record["seeds"] if (
        record["environment"]["name"], record["method"], seed) in asked]) for record in records)
    return [record for record in found if record["episodes"]]


def failures(store: EpisodeStore, records: Iterable[dict[str, Any]]) -> list[Failure]:
    """Return the failures of records of a store, in their order."""
    found = []
    for record in records:
        errors = {episode["seed"]: (episode["message"], store.traceback(record, episode["seed"]))
                  for episode in record["episodes"] if episode["status"] != "ok"}
        found += [Failure(record, seeds, *error)
                  for error, seeds in group_by(errors, errors.__getitem__).items()]
    return found


def write_page(store: EpisodeStore, boards: Sequence[Leaderboard],
               sweeps: Sequence[Sweep] = ()) -> Path:
    """Write ``index.html``, which needs no other file and no network, and return its path."""
    shown = [tables.run_table(board, drawn=True) for board in boards]
    runs = [run for board in boards for record in board.records for run in record["runs"]]
    html = render_template(
        "page.html.j2", root="", sections=list(zip(boards, shown, strict=True)), sweeps=sweeps,
        tables=tables, explanations=tables.explanations(shown), seed_ranges=seed_ranges,
        snapshots_of=partial(_snapshots, store), failures=partial(failures, store),
        colour_bar=_draw_bare(3.0, 0.12, lambda axes: axes.imshow(
            np.linspace(0, 1, 256)[None], cmap=FIELD_COLORMAP, aspect="auto")),
        runs=[group[0] for group in group_runs(runs, "command")])
    path = store.folder / "index.html"
    write_atomically(path, html)
    return path


def _snapshots(store: EpisodeStore, board: Leaderboard) -> dict[str, Any] | None:
    """Return truth and estimates in one episode, of the user's methods first and then of the best,
    without naive baselines, as PNG data; None if estimates are missing or do not fit the states."""
    chosen = [row.record for row in sorted(board.rows, key=lambda row: row.is_builtin)
              if row.record and scores_by_seed(row.record) and "floor" not in row.badges]
    chosen = chosen[:N_SNAPSHOT_METHODS]
    shared = set.intersection(*(set(scores_by_seed(each)) for each in chosen)) if chosen else ()
    environment = board.records[0]["environment"]
    if not shared or environment["id"] not in tracks.ids():  # its module may not be imported
        return None
    seed = min(shared)
    try:
        fields = [store.fields(record | {"seed": seed})["mean"] for record in chosen]
        env: Any = Environment(environment["id"], json.dumps(environment["kwargs"])).make()
        task = env.task
        for field in fields:
            _check.array("estimates", field, (task.n_steps, task.mesh.n_nodes))
    except FileNotFoundError:                                      # only the records were kept
        return None
    except ValueError as error:
        warnings.warn(f"no pictures of {seed}: {error}", stacklevel=2)
        return None
    truth = simulate(env.world, parse_seeds(seed)[0]).concentration
    times = task.warm_up + np.linspace(0.12, 0.88, N_SNAPSHOT_TIMES) * (task.n_steps - task.warm_up)
    rows = [(f"t = {1e3 * t * task.transport.time_step:.0f} ms",
             [_picture(task, truth_mesh(env.world), truth[t]),
              *(_picture(task, task.mesh, field[t - 1]) for field in fields)])
            for t in np.unique(np.maximum(times.astype(int), task.warm_up + 1))]
    return {"seed": seed, "columns": ["Truth", *(record["title"] for record in chosen)],
            "rows": rows, "range": colour_range(task), "size": _size(task), "tank": _is_tank(task)}


def _is_tank(task: Task) -> bool:
    return task.vessel is not None and not task.vessel.is_elongated


def _size(task: Task) -> str:
    """Return the size of the pictured region, and in 3D the section that is shown."""
    size = [f"{length:.3g} cm" for length in 100 * np.ptp(task.mesh.points, axis=0)]
    if task.mesh.dim == 3:
        return f"{size[2]} long, {size[0]} across, cut along the axis; flow from left to right"
    if _is_tank(task):
        return f"{size[0]} across"
    return f"{size[0]} × {size[1]}; flow from left to right"


def _picture(task: Task, mesh: Mesh, values: np.ndarray) -> str:
    """Return a field without axes as a data URI; in 3D the slice on the axis."""
    extent = np.ptp(mesh.points, axis=0)
    length, height = (extent[2], extent[1]) if mesh.dim == 3 else extent
    width = 2.6 if _is_tank(task) else 4.0  # inches; the style sheet keeps tanks small too
    return _draw_bare(width, width * height / length,
                 lambda axes: draw_field(axes, mesh, values, *colour_range(task)))


def _draw_bare(width: float, height: float, draw: Callable[[Axes], object]) -> str:
    """Draw on axes of this size in inches without frame and background."""
    figure = Figure(figsize=(width, height), dpi=90, facecolor="none")
    axes = figure.add_axes((0, 0, 1, 1), facecolor="none")
    draw(axes)
    axes.axis("off")
    return data_uri(figure_image(figure))
