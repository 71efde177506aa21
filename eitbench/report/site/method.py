"""The page of a method: where it stands on every board, what it is, how to play it again, and every
episode."""

from __future__ import annotations

import ast
import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from eitbench._files import shipped
from eitbench.bench.methods import baseline_folder, own_files, own_sha256, version_of
from eitbench.bench.records import alike, finished
from eitbench.bench.table import NOTHING, Cell, Table, number_cell
from eitbench.bench.text import scores_by_seed, seed_ranges
from eitbench.report import charts
from eitbench.report.boards import headings
from eitbench.report.site.beside import METHODS, Beside
from eitbench.report.site.collect import Board, Row, Site, title_of
from eitbench.report.site.environment import markdown
from eitbench.report.site.tables import SCALES, interval_cell, scale, three
from eitbench.report.templates import template

Standing = tuple[Board, Row]
Ends = Mapping[str, tuple[int, Mapping[str, tuple[float, float]]]]
"""Anchor of a board -> how many compete on it, and the ends of its drawn axes."""


def method_pages(site: Site, beside: Beside) -> dict[str, bytes]:
    """The HTML of the pages of all methods, by their path."""
    ends = {board.anchor: (sum(row.competes for row in board.rows),
                           {name: scale(board, name) for name in SCALES}) for board in site.boards}
    standings: dict[str, list[Standing]] = {name: [] for name in site.methods}
    for board in site.boards:
        for row in board.rows:
            standings[row.cells["method"]].append((board, row))
    records: dict[str, list[dict[str, Any]]] = {name: [] for name in site.methods}
    for record in site.records:
        records[record["method"]].append(record)
    return {f"methods/{name}.html":
            _page(name, records[name], standings[name], ends, beside).encode()
            for name in site.methods}


def _page(name: str, records: list[dict[str, Any]], standings: list[Standing], ends: Ends,
          beside: Beside) -> str:
    """The HTML of the page of all versions of a method."""
    records = sorted(records, key=lambda record: (record["official"], finished(record)),
                     reverse=True)
    versions = list(dict.fromkeys(record["version"] for record in records))
    return template("site/method.html.j2").render(
        root="../", links=beside.links("../"), name=name, title=records[0]["title"],
        standings=_standings(standings, ends),
        intervals=_intervals(standings),
        checkout=f"../{beside.root}../" if METHODS in beside.found else "",
        versions=[_version([record for record in records if record["version"] == each],
                           standings) for each in versions])


def _standings(standings: list[Standing], ends: Ends) -> Table:
    """A row for each board."""
    several = len({row.cells["version"] for _, row in standings}) > 1
    rows = []
    for board, row in standings:
        competing, axes = ends[board.anchor]
        rank = row.cells["rank"]
        link = f"../index.html#{board.anchor}" if board.is_aggregate else f"../{board.address}"
        cells: dict[str, Cell | str] = {
            "board": Cell(board.title, board.title.casefold(), link=link, small=board.of_class,
                          badges=row.badges)}
        if several:
            cells["version"] = row.cells["version"]
        rows.append(cells | {
            "rank": Cell(NOTHING) if rank is None else Cell(str(rank), float(rank),
                                                            small=f"of {competing}"),
            "ẽ_c": interval_cell(row, "error", axes["error"]),
            "gain": interval_cell(row, "gain", axes["gain"], mark=0.0),
            "ms/step": number_cell(row.cells["seconds_per_step"])})
    return Table.of(rows, label="Boards", keep=list(rows[0]) if rows else ())


def _intervals(standings: list[Standing]) -> Markup:
    """Gains on all boards, which are on one scale."""
    colours: dict[str, int] = {}
    series = [charts.Series(f"{board.title} · {board.of_class}" if board.is_aggregate
                            else board.title,
                            colours.setdefault(board.of_class, len(colours)),
                            np.array(three(row, "gain")))
              for board, row in standings if row.cells["gain"] is not None and not row.outdated]
    if not series:
        return Markup()
    return Markup(charts.intervals(series, "gain: 0 as the floor, 1 perfect", log=False, mark=0.0))


def _version(records: list[dict[str, Any]], standings: list[Standing]) -> dict[str, Any]:
    """What is said of one version: its file as far as it is ours and the same, and its records."""
    record = records[0]
    file = source_file(record)
    return {"name": record["version"], "sha256": record["method_sha256"],
            "checkpoint": record["checkpoint_sha256"],
            "parameters": {key: json.dumps(value, ensure_ascii=False)
                           for key, value in sorted(record["parameters"].items())},
            "file": file, "docstring": docstring(record, file),
            "records": [_record(each, standings) for each in sorted(
                records, key=lambda record: record["environment"]["name"])]}


def _record(record: dict[str, Any], standings: list[Standing]) -> dict[str, Any]:
    board, row = next(((board, row) for board, row in standings if row.record is record),
                      (None, None))  # it played none of the board's episodes
    return {"title": title_of(record), "address": board and board.address,
            "official": record["official"],
            "outdated": row is not None and row.outdated,
            "runs": _runs(record), "command": command(record),
            "typed": sorted({run["command"] for run in record["runs"]}),
            "episodes": _episodes(record),
            "failures": [episode for episode in record["episodes"] if episode["status"] != "ok"]}


def _runs(record: dict[str, Any]) -> list[dict[str, Any]]:
    """Runs of one code on one machine as one, with ``products``, the times in ms that its processes
    took for theirs."""
    return [group[0] | {"products": sorted(1000 * run["machine"]["matmul_seconds"]
                                           for run in group)}
            for group in alike(record["runs"])]


def _episodes(record: dict[str, Any]) -> Table:
    """A row for each episode, with the scores that any of them has."""
    shown = {"error": "ẽ_c"} | headings()
    scores = {name: values for name in shown if (values := scores_by_seed(record, name))}
    rows = [{
        "seed": Cell(episode["seed"], float(i)),
        "status": episode["status"],
        **{shown[name]: number_cell(values.get(episode["seed"]))
           for name, values in scores.items()},
        "played on": Cell(episode["finished"][:10], episode["finished"]),
    } for i, episode in enumerate(record["episodes"])]
    return Table.of(rows, label=f"Episodes of {title_of(record)}")


def command(record: dict[str, Any]) -> str:
    """What plays the record's episodes again; empty if the environment was given arguments, which
    no command takes.

    A file is named as it was when they were played.
    """
    if record["environment"]["kwargs"]:
        return ""
    kind = "--policy" if record["board"] == "injection" else "--baseline"
    return shlex.join(["eitbench", "submit", kind, _argument(record),
                       "--env", record["environment"]["id"],
                       "--seeds", seed_ranges(record["seeds"]), "--to", "again"])


def _argument(record: dict[str, Any]) -> str:
    """The name of a method, or the path that was typed for it, without the folders of whoever typed
    it.

    An agent's name says nothing of its file: where it is none of ours, the path is left to the
    reader.
    """
    for run in record["runs"]:
        try:
            words = shlex.split(run["command"])
        except ValueError:                                            # a quote that does not end
            continue
        for word in words:
            path = word.rpartition("=")[2]
            if Path(path).stem == record["method"] and path.endswith(".py"):
                return path if not Path(path).is_absolute() else Path(path).name
    file = source_file(record)
    if record["checkpoint_sha256"] is not None:
        return file or "path/to/model.zip"
    return record["method"]


def source_file(record: dict[str, Any]) -> str:
    """The method's file as it is named in this repository; empty if it is not there.

    Of agents, whose names others may give to theirs, the very version only.
    """
    path = own_files(record["environment"]["id"]).get(record["method"])
    if path is None or not (path.suffix == ".py" or _is_version(path, record)):
        return ""
    return f"baselines/{path.relative_to(baseline_folder()).as_posix()}"


def docstring(record: dict[str, Any], file: str) -> Markup:
    """Of the method's file, if this repository still holds the very version that was played."""
    path = shipped("baselines").parent / file
    if path.suffix != ".py" or not _is_version(path, record):
        return Markup()
    return markdown(ast.get_docstring(ast.parse(path.read_bytes())) or "")


def _is_version(path: Path, record: dict[str, Any]) -> bool:
    """Whether the file is what was played: of ours the same version, of others the very same."""
    sha256 = own_sha256(path)
    return record["version"] == version_of(path, sha256) or sha256 == record["method_sha256"]
