"""One self-contained HTML page: table, intervals, error over time and snapshots of each world."""

from __future__ import annotations

import base64
import io
import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from eitbench._files import write_atomically
from eitbench._foreign import cleaned
from eitbench.bench.records import alike
from eitbench.bench.store import EpisodeStore
from eitbench.bench.text import seed_ranges
from eitbench.bench.tracks import Environment
from eitbench.data.seeds import for_scores, parse_seeds
from eitbench.envs.rendering import FIELD_MAP, colour_range, draw_field
from eitbench.numerics.mesh import Mesh
from eitbench.report import charts
from eitbench.report.failures import failures
from eitbench.report.summary import board_label, explanations, method, shown
from eitbench.report.templates import template
from eitbench.worlds.task import Task

SHOWN = (("kalman_filter", "filter"), ("joint_extended_kalman_filter", "filter"),
         ("fixed_interval_smoother", "smoothing"), ("gauss_newton", "smoothing"))
"""Beside the truth in the snapshots: thesis Figs 5.4 and 5.6, and who estimates the flow too."""


def write_page(store: EpisodeStore, records: list[dict[str, Any]], table: pd.DataFrame) -> Path:
    """Write ``index.html``, which needs no other file and no network, and return its path."""
    sections = [_section(store, records, str(name), rows.reset_index(drop=True))
                for name, rows in table.groupby("world", sort=False)]
    headings = {heading for section in sections for heading in section["table"].headings}
    said = {heading: text for heading, text in explanations().items() if heading in headings}
    html = template("page.html.j2").render(
        sections=sections, explanations=said, colour_bar=_colour_bar(), runs=_runs(records))
    path = store.folder / "index.html"
    write_atomically(path, html.encode())
    return path


def _section(store: EpisodeStore, records: list[dict[str, Any]], name: str,
             table: pd.DataFrame) -> dict[str, Any]:
    """What the page shows of one world; the numbers of ``table``'s rows choose the colours."""
    ordered = [_record_of(records, row) for _, row in table.iterrows()]
    return {
        "name": name, "table": shown(table, grouped=True),
        "intervals": _intervals(table), "curves": _curves(ordered),
        "legend": [(i % charts.COLOURS, _title(record)) for i, record in enumerate(ordered)],
        "snapshots": _snapshots(store, ordered),
        "failures": [(method(failure.record), seed_ranges(failure.seeds), failure.message,
                      failure.traceback)
                     for failure in failures(store, ordered)],
    }


def _runs(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The distinct runs behind the records, each with its command, versions, commit and machine."""
    runs = (run for record in records for run in record["runs"])
    return [group[0] for group in alike(runs, "command")]


def _record_of(records: list[dict[str, Any]], row: pd.Series) -> dict[str, Any]:
    return next(record for record in records
                if (record["method"], record["environment"]["name"], record["split"])
                == (row["baseline"], row["environment"], row["split"]))


def _label(record: dict[str, Any] | pd.Series, title: str) -> str:
    return f"{title} · {board_label(record)}"


def _title(record: dict[str, Any]) -> str:
    return _label(record, method(record))


def _ok(record: dict[str, Any]) -> list[dict[str, Any]]:
    """The episodes that were played to their end."""
    return [episode for episode in record["episodes"] if episode["status"] == "ok"]


def _intervals(table: pd.DataFrame) -> str:
    rows = []
    for i, row in table.iterrows():
        if row["error"] is not None:
            mean, half = row["error"]
            ends = np.array([mean, mean - half, mean + half])
            rows.append(charts.Series(_label(row, row["method"]), int(str(i)), ends))
    return charts.intervals(sorted(rows, key=lambda s: s.values[0]), "ẽ_c") if rows else ""


def _curves(ordered: list[dict[str, Any]]) -> str:
    """Error of each scored step, averaged over the seeds."""
    played = [[episode["step_errors"] for episode in _ok(record)] for record in ordered]
    series = [charts.Series(_title(ordered[i]), i, np.mean(errors, axis=0))
              for i, errors in enumerate(played) if errors]
    steps = np.arange(1, max((len(s.values) for s in series), default=0) + 1)
    return charts.lines(steps, series, "scored injection", "relative error") if series else ""


def _snapshots(store: EpisodeStore, records: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Truth and estimates of one episode at four times, as PNG data; None if nothing can be shown.

    The records are of one world, which has one mesh and one time step. The episode is of the split
    that comes first in the table: methods that played other seeds share none with it.
    """
    records = [record for record in records if _ok(record)]
    records = [record for record in records if record["split"] == records[0]["split"]]
    chosen = [record for shown in SHOWN for record in records
              if (record["method"], record["board"]) == shown]
    chosen = chosen or records[:3]
    played = [{episode["seed"] for episode in _ok(record)} for record in chosen]
    shared = sorted(set.intersection(*played)) if played else []
    if not shared:
        return None
    seed = shared[0]
    try:
        fields = [store.fields(record | {"seed": seed})["mean"] for record in chosen]
    except FileNotFoundError:                                      # only the records were kept
        return None
    except ValueError as error:
        warnings.warn(f"no pictures of {seed}: {error}", stacklevel=2)
        return None
    world = chosen[0]["environment"]
    env: Any = Environment(world["id"], json.dumps(world["kwargs"])).make()
    with for_scores():
        env.reset(seed=parse_seeds(seed)[0])
    task = env.task
    if any(field.shape != (task.n_steps, task.mesh.n_nodes) for field in fields):
        warnings.warn(f"no pictures of {seed}: estimates of {cleaned(world['name'])} have another "
                      "shape than its states", stacklevel=2)
        return None
    truth = env.truth()
    times = task.warm_up + np.linspace(0.12, 0.88, 4) * (task.n_steps - task.warm_up)
    rows = []
    for t in np.maximum(times.astype(int), task.warm_up + 1):
        pictures = [_picture(task, env.truth_mesh(), truth[t - 1])]
        pictures += [_picture(task, task.mesh, field[t - 1]) for field in fields]
        rows.append((f"t = {1e3 * t * task.transport.time_step:.0f} ms", pictures))
    low, high = colour_range(task)
    return {"seed": seed, "columns": ["Truth", *map(method, chosen)], "rows": rows,
            "low": f"{low:g}", "high": f"{high:g}", "size": _size(task), "tank": _is_tank(task)}


def _is_tank(task: Task) -> bool:
    """Whether pictures of it stand side by side; those of long vessels lie one below the other."""
    return task.vessel is not None and not task.vessel.is_long


def _size(task: Task) -> str:
    """What is to be seen: how large it is, and in 3D which part."""
    size = [f"{length:.3g} cm" for length in 100 * np.ptp(task.mesh.points, axis=0)]
    if task.mesh.dim == 3:
        return f"{size[2]} long, {size[0]} across, cut along the axis; flow from left to right"
    if _is_tank(task):
        return f"{size[0]} across"
    return f"{size[0]} × {size[1]}; flow from left to right"


def _picture(task: Task, mesh: Mesh, values: np.ndarray) -> str:
    """The field without axes, transparent outside, as a data URI; in 3D the slice on the axis."""
    extent = np.ptp(mesh.points, axis=0)
    length, height = (extent[2], extent[1]) if mesh.dim == 3 else extent
    width = 2.6 if _is_tank(task) else 4.0  # inches; the style sheet keeps tanks small too
    return _data_uri(width, width * height / length,
                     lambda axes: draw_field(axes, mesh, values, *colour_range(task)))


def _colour_bar() -> str:
    bar = np.linspace(0, 1, 256)[None]
    return _data_uri(3.0, 0.12, lambda axes: axes.imshow(bar, cmap=FIELD_MAP, aspect="auto"))


def _data_uri(width: float, height: float, draw: Callable[[Axes], object]) -> str:
    """What is drawn on bare axes of this size in inches, as a PNG."""
    figure = Figure(figsize=(width, height), dpi=90)
    axes = figure.add_axes((0, 0, 1, 1))
    draw(axes)
    axes.axis("off")
    content = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(content, format="png", transparent=True)
    return "data:image/png;base64," + base64.b64encode(content.getvalue()).decode()
