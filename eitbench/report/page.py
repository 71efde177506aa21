"""One self-contained HTML page: table, intervals, error over time and snapshots of each world."""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from eitbench._files import write_atomically
from eitbench.bench.records import alike
from eitbench.bench.store import EpisodeStore
from eitbench.bench.tracks import Environment
from eitbench.data.seeds import parse_seeds
from eitbench.envs.rendering import FIELD_MAP, colour_range, draw_field
from eitbench.numerics.mesh import Mesh
from eitbench.report import charts
from eitbench.report.summary import board_label, explanations, method, shown
from eitbench.report.templates import template
from eitbench.worlds.task import Task

SHOWN = (("kalman_filter", "filter"), ("joint_extended_kalman_filter", "filter"),
         ("fixed_interval_smoother", "smoothing"), ("gauss_newton", "smoothing"))
"""Beside the truth, in the snapshots: thesis Figs 5.4 and 5.6, and who estimates the flow too where
it is asked for."""


def write_page(store: EpisodeStore, records: list[dict[str, Any]], table: pd.DataFrame) -> Path:
    """Write ``index.html`` into the store's folder and return its path; it needs no other file and
    no network."""
    sections = [_section(store, records, str(name), rows.reset_index(drop=True))
                for name, rows in table.groupby("world", sort=False)]
    headings = {heading for section in sections for heading in section["table"].headings}
    said = {heading: text for heading, text in explanations().items() if heading in headings}
    html = template("page.html.j2").render(
        sections=sections, explanations=said, colour_bar=_colour_bar(), runs=_runs(records))
    path = store.folder / "index.html"
    write_atomically(path, html.encode())
    return path


def _section(store: EpisodeStore, records: list[dict[str, Any]], name: str, table: pd.DataFrame) -> dict[str, Any]:
    """What the page shows of one world; ``table`` has its rows, numbered from 0, which choose the
    colours."""
    ordered = [_record_of(records, row) for _, row in table.iterrows()]
    return {
        "name": name, "table": shown(table, grouped=True),
        "intervals": _intervals(table), "curves": _curves(ordered), "legend": _legend(ordered),
        "snapshots": _snapshots(store, ordered),
        "failures": [(method(record), episode["seed"], episode["message"]) for record in ordered
                     for episode in record["episodes"] if episode["status"] != "ok"],
    }


def _runs(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The distinct runs behind the records, each with its command, versions, commit and machine."""
    return [group[0] for group in alike((run for record in records for run in record["runs"]), "command")]


def _record_of(records: list[dict[str, Any]], row: pd.Series) -> dict[str, Any]:
    return next(record for record in records
                if (record["method"], record["environment"]["name"], record["split"])
                == (row["baseline"], row["environment"], row["split"]))


def _label(record: dict[str, Any] | pd.Series, title: str) -> str:
    return f"{title} · {board_label(record)}"


def _intervals(table: pd.DataFrame) -> str:
    rows = [charts.Series(_label(row, row["method"]), int(str(i)), _ends(*row["error"]))
            for i, row in table.iterrows() if row["error"] is not None]
    return charts.intervals(sorted(rows, key=lambda s: s.values[0]), "ẽ_c") if rows else ""


def _ends(mean: float, half: float) -> np.ndarray:
    return np.array([mean, mean - half, mean + half])


def _legend(ordered: list[dict[str, Any]]) -> list[tuple[int, str]]:
    return [(i % charts.COLOURS, _label(record, method(record))) for i, record in enumerate(ordered)]


def _curves(ordered: list[dict[str, Any]]) -> str:
    """Error of each scored step, averaged over the seeds."""
    series, steps = [], 0
    for i, record in enumerate(ordered):
        errors = [episode["step_errors"] for episode in record["episodes"] if episode["status"] == "ok"]
        if errors:
            series.append(charts.Series(_label(record, method(record)), i, np.mean(errors, axis=0)))
            steps = max(steps, len(errors[0]))
    return charts.lines(np.arange(1, steps + 1), series, "scored injection", "relative error") if series else ""


def _snapshots(store: EpisodeStore, records: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Truth and estimates of one episode at four times, as PNG data; None if nothing can be shown.

    The records are of one world, which has one mesh and one time step. The episode is of the split
    that comes first in the table: methods that played other seeds share none with it.
    """
    records = [record for record in records if any(e["status"] == "ok" for e in record["episodes"])]
    records = [record for record in records if record["split"] == records[0]["split"]]
    chosen = [record for name, board in SHOWN for record in records
              if record["method"] == name and record["board"] == board]
    chosen = chosen or records[:3]
    played = [{e["seed"] for e in record["episodes"] if e["status"] == "ok"} for record in chosen]
    shared = sorted(set.intersection(*played)) if played else []
    if not shared:
        return None
    seed = shared[0]
    try:
        fields = [store.fields(record | {"seed": seed})["mean"] for record in chosen]
    except FileNotFoundError:                                      # only the records were kept
        return None
    world = chosen[0]["environment"]
    env: Any = Environment(world["id"], json.dumps(world["kwargs"])).make()
    env.reset(seed=parse_seeds(seed)[0])
    task, truth = env.task, env.truth()
    times = task.warm_up + np.linspace(0.12, 0.88, 4) * (task.n_steps - task.warm_up)
    rows = []
    for t in np.maximum(times.astype(int), task.warm_up + 1):
        pictures = [_picture(task, env.truth_mesh(), truth[t - 1])]
        pictures += [_picture(task, task.mesh, field[t - 1]) for field in fields]
        rows.append((f"t = {1e3 * t * task.transport.time_step:.0f} ms", pictures))
    low, high = colour_range(task)
    return {"seed": seed, "columns": ["Truth", *(method(record) for record in chosen)], "rows": rows,
            "low": f"{low:g}", "high": f"{high:g}", "size": _size(task), "tank": _is_tank(task)}


def _is_tank(task: Task) -> bool:
    """Whether pictures of it stand side by side; those of long vessels lie one below the other."""
    return task.vessel is not None and not task.vessel.is_long


def _size(task: Task) -> str:
    """What is to be seen: how large it is, and in 3D which part."""
    size = [f"{length:.3g} cm" for length in 100 * np.ptp(task.mesh.points, axis=0)]
    if task.mesh.dim == 3:
        return f"{size[2]} long, {size[0]} across, cut along the axis; flow from left to right"
    return f"{size[0]} across" if _is_tank(task) else f"{size[0]} × {size[1]}; flow from left to right"


def _picture(task: Task, mesh: Mesh, values: np.ndarray) -> str:
    """The field without axes, transparent outside, as a data URI; in 3D the slice along the axis."""
    extent = np.ptp(mesh.points, axis=0)
    length, height = (extent[2], extent[1]) if mesh.dim == 3 else extent
    width = 2.6 if _is_tank(task) else 4.0  # inches; the style sheet keeps tanks small too
    figure = Figure(figsize=(width, width * height / length), dpi=90)
    axes = figure.add_axes((0, 0, 1, 1))
    draw_field(axes, mesh, values, *colour_range(task))
    axes.axis("off")
    return _data_uri(figure)


def _colour_bar() -> str:
    figure = Figure(figsize=(3.0, 0.12), dpi=90)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.imshow(np.linspace(0, 1, 256)[None], cmap=FIELD_MAP, aspect="auto")
    axes.axis("off")
    return _data_uri(figure)


def _data_uri(figure: Figure) -> str:
    content = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(content, format="png", transparent=True)
    return "data:image/png;base64," + base64.b64encode(content.getvalue()).decode()
