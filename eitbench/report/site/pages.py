"""Pages of the site: the index with its headline, one for each environment and each method."""

from __future__ import annotations

import ast
import json
import math
import re
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from eitbench._files import shipped
from eitbench.bench.methods import baseline_folder, own_files, own_sha256, version_of
from eitbench.bench.records import alike, file_name, finished
from eitbench.bench.table import NOTHING, Cell, Table, number_cell
from eitbench.bench.text import scores_by_seed
from eitbench.bench.tracks import home_of, named
from eitbench.envs.pages import page
from eitbench.report import charts, figures
from eitbench.report.boards import counted
from eitbench.report.model import ALL, Board, Row, headings, title_of
from eitbench.report.site.collect import HEADLINE, MEASURED, METHODS, ROBUSTNESS, Beside, Site
from eitbench.report.site.measured import Measured
from eitbench.report.site.robustness import families
from eitbench.report.tables import Axes, Line, explanations, lines, page_table
from eitbench.report.templates import markdown

ABOUT = {
    "filter": "Estimates of each moment from the measurements until then.",
    "fixed-lag": "Estimates of each moment from the measurements until a few later.",
    "smoothing": "Estimates of each moment from the whole record.",
    "stationary": "Targets that stand still.",
    "injection": "The next current is chosen; a Kalman filter inside makes the estimate.",
}
"""Class -> task."""
PIPE, AGENTS = "eitbench-Pipe2D-v0", "eitbench-Pipe2DInjectionBudget-v0"
COMPARED = ("homogeneous", "gauss_newton", "extended_kalman_filter")
MULTIPLES = ("two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven",
             "twelve")
Placement = tuple[Board, Row]


def index_page(site: Site, beside: Beside, measured: Measured) -> bytes:
    """Return the HTML of ``index.html``."""
    tables = {board.anchor: page_table(board, "", compact=True) for board in site.boards}
    classes = [{"name": name, "about": ABOUT[name],
                "boards": [(board, tables[board.anchor], Axes.of(board).drawn())
                           for board in boards]} for name, boards in site.classes.items()]
    top = headline(site)
    return beside.page(
        "index", headline=top,
        figures=[*([top.figure] if top else []), *key_figures(site)],
        moving=beside.picture(HEADLINE[0], ""), still=beside.picture(HEADLINE[1], ""),
        n_environments=sum(not board.is_aggregate for board in site.boards),
        n_records=len(site.records),
        n_methods=len({record["method"] for record in site.records}), classes=classes,
        robustness=ROBUSTNESS if families(site) else "",
        measured=MEASURED if measured.records else "",
        last=max(map(finished, site.records), default="")[:10],
        explanations=explanations(tables.values()))


class KeyFigure(NamedTuple):
    """One of the numbers below the headline."""

    value: str
    about: str
    board: Board


class Headline(NamedTuple):
    """The comparison of an image with and without a flow model."""

    text: str
    measured: str
    figure: KeyFigure


def headline(site: Site) -> Headline | None:
    """Return how many times a flow model reduces the error; None without official records."""
    board = site.board("filter", PIPE)
    errors = {row.cells["method"]: row.cells["error"] for row in (board.rows if board else ())
              if row.cells["official"] and row.complete}
    if board is None or not set(COMPARED) <= errors.keys():
        return None
    flat, stationary, filtered = (errors[name] for name in COMPARED)
    times = stationary / filtered
    if not 2 <= times < len(MULTIPLES) + 2:
        return None
    return Headline(
        f"A flow model cuts the error {MULTIPLES[int(times) - 2]}fold",
        f"Images of a target that is assumed to stand still (Gauss–Newton) have an error of "
        f"{stationary:#.2g}, those of an extended Kalman filter with a model of the flow "
        f"{filtered:#.2g}: {times:.1f} times less, or {math.sqrt(times):.1f} times by its root. "
        f"The error is the squared distance from the truth over the square of the truth, the mean "
        f"over {board.seeds} of {board.title}. The best homogeneous image has {flat:#.2g}.",
        KeyFigure(f"{flat / filtered:.1f} ×", "less error than the best homogeneous image: the "
                  f"extended Kalman filter on {board.title}", board))


def key_figures(site: Site) -> list[KeyFigure]:
    """Return up to two: gains of the best filter and of the best trained agent."""
    found = []
    board = site.board("filter", ALL)
    best = _best(lines(board)) if board else None
    if board and best:
        count = sum(each.of_class == "filter" and each.environment in counted()
                    for each in site.boards)
        found.append(KeyFigure(_percent(best), "less error than the floor with the best filter "
                               f"({best.row.cells['title']}), over {count} environments", board))
    board = site.board("injection", AGENTS)
    placed = lines(board) if board else []
    agent = _best([line for line in placed if line.parts])
    rule = _best([line for line in placed if not line.parts])
    if board and agent and rule:
        found.append(KeyFigure(
            _percent(agent), "less error than random pairs with an agent trained to choose when "
            f"and where to inject ({agent.row.cells['title']}, mean of {len(agent.parts)} "
            f"trainings, on {board.title}); {_percent(rule)} with the best written rule", board))
    return found


def _best(placed: list[Line]) -> Line | None:
    return next((line for line in placed if line.row.competes), None)


def _percent(line: Line) -> str:
    return f"{line.row.cells['gain']:.0%}".replace("%", " %")


def environment_page(site: Site, board: Board, beside: Beside) -> bytes:
    """Return the HTML of the page, which offers to play the animation ``beside`` the site."""
    id = next(row.record["environment"]["id"] for row in board.rows if row.record)
    table = page_table(board, "../")
    description, details = documentation(id)
    animation = f"{board.environment}.webp"
    return beside.page(
        "environment", "../", board=board, id=id,
        table=table, axes=Axes.of(board).drawn(), explanations=explanations([table]),
        description=description, details=details,
        intervals=figures.error_chart(board), front=figures.cost_chart(board),
        curves=figures.curve_chart(board),
        moving=beside.picture(quote(animation), "../"),
        media_mb=f"{1e-6 * beside.media.get(animation, 0):.1f} MB",
        robustness=ROBUSTNESS if home_of(id) and named(id, {}) == board.environment else "",
        siblings=[other for other in site.classes[board.of_class]
                  if other is not board and not other.is_aggregate])


def documentation(id: str) -> tuple[Markup, Markup]:
    """Return the description of an id and the remaining sections of its page, as HTML."""
    text = re.sub(r"\A\s*## Description\s*", "", page(id))
    first, rest = re.split(r"^(?=## |\|)", text, maxsplit=1, flags=re.MULTILINE)
    return markdown(first), markdown(rest)


def method_page(site: Site, name: str, beside: Beside) -> bytes:
    """Return the HTML of the page of all versions of a method."""
    records = sorted((record for record in site.records if record["method"] == name),
                     key=lambda record: (record["official"], finished(record)), reverse=True)
    placements = [(board, row) for boards in site.classes.values() for board in boards
                  for row in board.rows if row.cells["method"] == name]
    addresses = {(row.cells["environment"], row.cells["version"]): board.address
                 for board, row in placements}
    versions = dict.fromkeys(record["version"] for record in records)
    return beside.page(
        "method", "../", name=name, title=records[0]["title"],
        placements=_table(placements), gains=_gains(placements),
        checkout=f"../{beside.root}../" if METHODS in beside.found else "",
        versions=[_version([record for record in records if record["version"] == version],
                           addresses) for version in versions])


def _table(placements: list[Placement]) -> Table:
    """Return one row for each board."""
    rows = []
    for board, row in placements:
        axes = Axes.of(board)
        rank = row.cells["rank"]
        link = f"../index.html#{board.anchor}" if board.is_aggregate else f"../{board.address}"
        rows.append({
            "board": Cell(board.title, board.title.casefold(), link=link,
                          small=f"{board.of_class} · {row.cells['version']}", badges=row.badges),
            "rank": Cell(NOTHING) if rank is None else Cell(
                str(rank), float(rank), small=f"of {sum(each.competes for each in board.rows)}"),
            "ẽ_c": axes.cell(row, "error"), "gain": axes.cell(row, "gain"),
            "ms/step": number_cell(row.cells["seconds_per_step"])})
    return Table.of(rows, label="Boards", keep=list(rows[0]) if rows else ())


def _gains(placements: list[Placement]) -> dict[str, Any] | None:
    """Draw the gains on all boards."""
    colours: dict[str, int] = {}
    series = [charts.Series(f"{board.title} · {board.of_class}" if board.is_aggregate
                            else board.title,
                            colours.setdefault(board.of_class, len(colours)),
                            np.array(row.three("gain")))
              for board, row in placements if row.cells["gain"] is not None]
    if not series:
        return None
    svg = charts.intervals(series, "gain: 0 as the floor, 1 perfect", log=False, mark=0.0)
    return {"svg": Markup(svg), "legend": []}


def _version(records: list[dict[str, Any]], addresses: dict[tuple[str, str], str]
             ) -> dict[str, Any]:
    """Return the properties of one version, and its records."""
    record = records[0]
    file = source_file(record)
    shown = []
    for each in sorted(records, key=lambda record: record["environment"]["name"]):
        runs = [group[0] | {"products": sorted(1000 * run["machine"]["matmul_seconds"]
                                               for run in group)} for group in alike(each["runs"])]
        shown.append({
            "title": title_of(each), "official": each["official"], "runs": runs,
            "file": file_name(each), "episodes": _episodes(each),
            "address": addresses.get((each["environment"]["name"], each["version"])),
            "commands": sorted({run["command"] for run in each["runs"]}),
            "failures": [episode for episode in each["episodes"] if episode["status"] != "ok"]})
    return {"name": record["version"], "sha256": record["method_sha256"],
            "checkpoint": record["checkpoint_sha256"], "file": file,
            "docstring": docstring(record, file), "records": shown,
            "parameters": {key: json.dumps(value, ensure_ascii=False)
                           for key, value in sorted(record["parameters"].items())}}


def _episodes(record: dict[str, Any]) -> Table:
    """Return one row for each episode, with the scores that any of them has."""
    shown = {"error": "ẽ_c"} | headings()
    scores = {name: values for name in shown if (values := scores_by_seed(record, name))}
    return Table.of([{
        "seed": Cell(episode["seed"], float(i)), "status": episode["status"],
        **{shown[name]: number_cell(values.get(episode["seed"]))
           for name, values in scores.items()},
        "date": Cell(episode["finished"][:10], episode["finished"]),
    } for i, episode in enumerate(record["episodes"])], label=f"Episodes of {title_of(record)}")


def source_file(record: dict[str, Any]) -> str:
    """Return the path of a built-in method's file in this repository; empty if it is not there.

    Agents must be the very version, since others may use their names.
    """
    path = own_files(record["environment"]["id"]).get(record["method"])
    if path is None or not (path.suffix == ".py" or _is_version(record, path)):
        return ""
    return f"baselines/{path.relative_to(baseline_folder()).as_posix()}"


def docstring(record: dict[str, Any], file: str) -> Markup:
    """Return the docstring of the method's file, if this repository holds the recorded version."""
    path = shipped("baselines").parent / file
    if path.suffix != ".py" or not _is_version(record, path):
        return Markup()
    return markdown(ast.get_docstring(ast.parse(path.read_bytes())) or "")


def _is_version(record: dict[str, Any], path: Any) -> bool:
    """Return whether a file is the recorded version: by number, of third parties by content."""
    sha256 = own_sha256(path)
    return record["version"] == version_of(path, sha256) or sha256 == record["method_sha256"]
