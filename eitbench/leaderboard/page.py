"""One self-contained HTML page: table, intervals, error over time, snapshots."""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

from eitbench._files import write_atomically
from eitbench.envs.estimation import EstimationEnv
from eitbench.envs.rendering import FIELD_MAP, colour_range
from eitbench.leaderboard import charts
from eitbench.leaderboard.run import Environment
from eitbench.leaderboard.store import EpisodeStore
from eitbench.leaderboard.summary import EXPLANATIONS, board_label, cells
from eitbench.physics.mesh import Mesh
from eitbench.seeds import parse_seeds

COLOURS = 12
"""--c0 … --c11 of the style sheet"""
SHOWN = (("kalman_filter", "filter"), ("fixed_interval_smoother", "smoothing"), ("gauss_newton", "smoothing"))
"""Beside the truth, in the snapshots: thesis Figs 5.4 and 5.6."""


def write_page(store: EpisodeStore, records: list[dict[str, Any]], table: pd.DataFrame) -> Path:
    """Write ``index.html`` into the store's folder and return its path; it needs no other file and no network."""
    environment = jinja2.Environment(loader=jinja2.PackageLoader("eitbench.leaderboard", "."), autoescape=True,
                                     trim_blocks=True, lstrip_blocks=True)
    text = cells(table)
    ordered = [_record_of(records, row) for _, row in table.iterrows()]
    html = environment.get_template("page.html.j2").render(
        headings=list(text.columns)[1:], explanations=EXPLANATIONS,
        boards=[(board, rows.iloc[:, 1:].to_numpy().tolist()) for board, rows in text.groupby("board", sort=False)],
        intervals=_intervals(table), curves=_curves(ordered), legend=_legend(ordered),
        snapshots=_snapshots(store, ordered),
        colour_bar=_colour_bar(), runs=_runs(records),
        failures=[(record["title"], episode["seed"], episode["message"]) for record in records
                  for episode in record["episodes"] if episode["status"] != "ok"],
    )
    path = store.folder / "index.html"
    write_atomically(path, html.encode())
    return path


def _runs(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The distinct runs behind the records, each with its command, versions, commit and machine."""
    runs: list[dict[str, Any]] = []
    for record in records:
        runs += [run for run in record["runs"] if run not in runs]
    return runs


def _record_of(records: list[dict[str, Any]], row: pd.Series) -> dict[str, Any]:
    return next(record for record in records
                if (record["baseline"], record["environment"]["name"], record["split"])
                == (row["baseline"], row["environment"], row["split"]))


def _label(record: dict[str, Any] | pd.Series, title: str) -> str:
    return f"{title} · {board_label(record)}"


def _intervals(table: pd.DataFrame) -> str:
    rows = [charts.Series(_label(row, row["method"]), int(str(i)) % COLOURS, np.array(row["error"]))
            for i, row in table.iterrows() if row["error"] is not None]
    return charts.intervals(sorted(rows, key=lambda s: s.values[0]), "ẽ_c") if rows else ""


def _legend(ordered: list[dict[str, Any]]) -> list[tuple[int, str]]:
    return [(i % COLOURS, _label(record, record["title"])) for i, record in enumerate(ordered)]


def _curves(ordered: list[dict[str, Any]]) -> str:
    """Error of each scored step, averaged over the seeds."""
    series, steps = [], 0
    for i, record in enumerate(ordered):
        errors = [episode["step_errors"] for episode in record["episodes"] if episode["status"] == "ok"]
        if errors:
            series.append(charts.Series(_label(record, record["title"]), i % COLOURS, np.mean(errors, axis=0)))
            steps = len(errors[0])
    return charts.lines(np.arange(1, steps + 1), series, "scored injection", "relative error") if series else ""


def _snapshots(store: EpisodeStore, records: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Truth and estimates of one episode at four times, as PNG data; None if nothing can be shown.

    The episode is of the split that comes first in the table: methods that played other seeds share none with it.
    """
    records = [record for record in records if any(e["status"] == "ok" for e in record["episodes"])]
    records = [record for record in records if record["split"] == records[0]["split"]]
    chosen = [record for name, board in SHOWN for record in records
              if record["baseline"] == name and record["board"] == board]
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
    env = Environment(world["id"], json.dumps(world["kwargs"])).make()
    env.reset(seed=parse_seeds(seed)[0])
    task, truth = env.task, env.truth()
    times = task.warm_up + np.linspace(0.12, 0.88, 4) * (task.n_steps - task.warm_up)
    rows = []
    for t in times.astype(int):
        pictures = [_picture(env, env.truth_mesh(), truth[t - 1])]
        pictures += [_picture(env, task.mesh, field[t - 1]) for field in fields]
        rows.append((f"t = {1e3 * t * task.transport.time_step:.0f} ms", pictures))
    low, high = colour_range(task)
    length, width = 100 * np.ptp(task.mesh.points, axis=0)
    return {"seed": seed, "columns": ["Truth", *(record["title"] for record in chosen)], "rows": rows,
            "low": f"{low:g}", "high": f"{high:g}", "size": f"{length:g} cm × {width:g} cm"}


def _picture(env: EstimationEnv, mesh: Mesh, values: np.ndarray) -> str:
    """The field without axes, transparent outside, as a data URI."""
    extent = np.ptp(mesh.points, axis=0)
    figure = Figure(figsize=(4.0, 4.0 * extent[1] / extent[0]), dpi=90)
    axes = figure.add_axes((0, 0, 1, 1))
    low, high = colour_range(env.task)
    triangles = Triangulation(mesh.points[:, 0], mesh.points[:, 1], mesh.cells)
    axes.tripcolor(triangles, values, shading="gouraud", cmap=FIELD_MAP, vmin=low, vmax=high)
    axes.set_aspect("equal")
    axes.margins(0)
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
