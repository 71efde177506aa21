"""The page of a method: its results on all boards, its description, and every episode."""

from __future__ import annotations

import ast
import json
from typing import Any

import numpy as np
from markupsafe import Markup

from eitbench._files import shipped
from eitbench.bench.methods import baseline_folder, own_files, own_sha256, version_of
from eitbench.bench.records import alike, file_name, finished
from eitbench.bench.table import NOTHING, Cell, Table, number_cell
from eitbench.bench.text import scores_by_seed
from eitbench.report import charts
from eitbench.report.model import Board, Row, headings, title_of
from eitbench.report.site.beside import METHODS, Beside
from eitbench.report.site.collect import Site
from eitbench.report.site.environment import markdown
from eitbench.report.tables import Axes
from eitbench.report.templates import template

Placement = tuple[Board, Row]


def method_page(site: Site, name: str, beside: Beside) -> bytes:
    """Return the HTML of the page of all versions of a method."""
    records = sorted((record for record in site.records if record["method"] == name),
                     key=lambda record: (record["official"], finished(record)), reverse=True)
    placements = [(board, row) for boards in site.classes.values() for board in boards
                  for row in board.rows if row.cells["method"] == name]
    addresses = {(row.cells["environment"], row.cells["version"]): board.address
                 for board, row in placements}
    versions = dict.fromkeys(record["version"] for record in records)
    return template("site/method.html.j2").render(
        root="../", links=beside.links("../"), name=name, title=records[0]["title"],
        placements=_table(placements), gains=_gains(placements),
        checkout=f"../{beside.root}../" if METHODS in beside.found else "",
        versions=[_version([record for record in records if record["version"] == version],
                           addresses) for version in versions]).encode()


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
