"""Leaderboards as a static site, as Markdown, and as CSV.

Rendered from the records and from what the repository holds: docstrings of environments and
methods, files and checkpoints of built-in methods, animations. The same records and the same
checkout give the same bytes.
"""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from markupsafe import Markup

from eitbench._files import PACKAGE, replace_folder
from eitbench._sanitize import escape_csv
from eitbench.bench import records as stored
from eitbench.bench.methods import baseline_folder, builtin_files, builtin_sha256, version_of
from eitbench.bench.scores import scores
from eitbench.bench.table import Cell, Table, number_cell
from eitbench.bench.text import scores_by_seed
from eitbench.bench.tracks import environment_name, nominal_id, qualified_name
from eitbench.envs.env_docs import describe_environment
from eitbench.report import boards, tables
from eitbench.report.boards import ALL, Leaderboard, MethodRow
from eitbench.report.charts import Axis
from eitbench.report.site import measured, robustness
from eitbench.report.templates import markdown, render_template
from eitbench.worlds.registry import entries

CATEGORY_TEXTS = {
    "filter": "Each state is estimated from the measurements until then (filtering).",
    "fixed-lag": "Each state is estimated from the measurements until a few steps later.",
    "smoothing": "Each state is estimated from all measurements of the episode.",
    "stationary": "Targets that do not move.",
    "injection": "The policy chooses the next current; a built-in filter estimates the state.",
}
"""Class -> task."""
HEADLINE_ENVIRONMENT, AGENT_ENVIRONMENT = "eitbench-Pipe2D-v0", "eitbench-Pipe2DInjectionBudget-v0"
HEADLINE_METHODS = ("homogeneous", "gauss_newton", "extended_kalman_filter")
HEADLINE = "media/headline.webp", "media/headline.png"
"""Animation of the first page, and its still picture, from the leaderboards' folder."""
LINKS = {"Submit a method": "README.md", "Statistics": "../docs/statistics.md",
         "Code": "../README.md"}
"""Link of every page -> file, from the leaderboards' folder."""
SITE_MARKER = b"<strong>eitbench</strong> leaderboards"
"""Text by which the index.html of a site is recognised."""


class Site(NamedTuple):
    """Contents of all pages."""

    boards: list[Leaderboard]
    """Class by class, each followed by its aggregate."""
    records: list[dict[str, Any]]
    """Sorted; superseded ones included."""
    measured: measured.MeasuredBoards
    folder: Path | None
    """Folder of the leaderboards, which will hold the site; pages link to files around it."""

    @property
    def classes(self) -> dict[str, list[Leaderboard]]:
        """Class -> its boards, the aggregate first."""
        found: dict[str, list[Leaderboard]] = {board.category: [] for board in self.boards}
        for board in sorted(self.boards, key=lambda board: not board.is_aggregate):
            found[board.category].append(board)
        return found

    def board(self, category: str, environment: str) -> Leaderboard | None:
        """Return one of the boards, if there is one."""
        return next((board for board in self.boards
                     if (board.category, board.environment) == (category, environment)), None)

    @property
    def families(self) -> list[robustness.ShiftFamily]:
        """Nominal environments with their shifted ones."""
        return robustness.shift_families(self.boards)

    def address(self, name: str, root: str = "") -> str:
        """Return the address of a file, given by its path from the leaderboards' folder, from a
        page from which ``root`` leads to the site; empty if the file is missing."""
        return f"{root}../{name}" if self.folder and (self.folder / name).exists() else ""

    def page(self, kind: str, root: str = "", /, **contents: Any) -> bytes:
        """Render a template of the site for a page from which ``root`` leads to the site."""
        links = {words: self.address(name, root) for words, name in LINKS.items()}
        return render_template(f"site/{kind}.html.j2", root=root, links=links, site=self,
                               tables=tables, robustness=robustness, **contents)


def collect(records: Iterable[dict[str, Any]], folder: Path | None = None) -> Site:
    """Return the site of the records, and of the measured records in a ``folder`` of leaderboards.
    """
    ordered = sorted(records, key=lambda record: (
        record["environment"]["name"], record["method"], record["version"]))
    found = measured.MeasuredBoards.of(folder) if folder else measured.MeasuredBoards({}, {}, [])
    return Site(boards.leaderboards(ordered), ordered, found, folder)


def render_site(site: Site) -> dict[str, bytes]:
    """Return all files of the site, by their path within it."""
    files = {"index.html": index_page(site)}
    for board in site.boards:
        if not board.is_aggregate:
            files[f"environments/{board.environment}.html"] = environment_page(site, board)
    for name in dict.fromkeys(record["method"] for record in site.records):
        files[f"methods/{name}.html"] = method_page(site, name)
    if site.families:
        files["robustness.html"] = site.page("robustness")
    if site.measured.records:
        files["measured.html"] = site.page("measured", explanations=measured.MEASURED_COLUMNS)
    return files | {name: (PACKAGE / "report" / name).read_bytes()
                    for name in ("style.css", "script.js")}


def render(site: Site) -> dict[str, str]:
    """Return the content of ``leaderboard.csv``, with the names and SI units of
    `eitbench.bench.load`, and of ``leaderboard.md``, by file name; records of measurement files are
    in the second only."""
    text = render_template(
        "site/leaderboard.md.j2", site=site, tables=tables, robustness=robustness,
        measured_columns=measured.MEASURED_COLUMNS,
        columns=boards.column_descriptions(measured=False),
        superseded=list(map(stored.record_file_name, stored.split_outdated(site.records)[1])))
    table = boards.leaderboard_table(site.boards).replace({"environment": {
        record["environment"]["name"]: qualified_name(record["environment"])
        for record in site.records}})
    for name, score in scores().items():
        table[name] /= score.factor
    table["peak_memory"] /= 1e-6
    names = ["environment", "method", "title"]
    table[names] = table[names].map(escape_csv)
    return {"leaderboard.csv": table.to_csv(index=False, float_format="%.6g", lineterminator="\n"),
            "leaderboard.md": text.decode()}


def write_site(folder: Path, files: Mapping[str, bytes]) -> None:
    """Make the folder hold these files and no others, all at once: an interruption leaves the
    previous site. ``ValueError`` if the folder is neither empty nor such a site, which leaves it
    unchanged."""
    index = folder / "index.html"
    is_site = index.is_file() and SITE_MARKER in index.read_bytes()
    if folder.exists() and any(folder.iterdir()) and not is_site:
        raise ValueError("folder must be empty or hold a site of the leaderboards, since other "
                         f"files in it are deleted; {folder} holds something else")
    replace_folder(folder, files)


# -- index -----------------------------------------------------------------------------------------


def index_page(site: Site) -> bytes:
    """Return the HTML of ``index.html``."""
    apart = {environment_name(id, {}) for id, each in entries().items() if each.is_reference}
    together = boards.aggregate_environments()
    shown = {board.anchor: tables.page_table(board, "", compact=True) for board in site.boards
             if board.environment not in apart}
    filters, policies = site.board("filter", ALL), site.board("injection", AGENT_ENVIRONMENT)
    best = [[row for row in board.group_trainings() if row.is_ranked] if board else []
            for board in (filters, policies)]
    return site.page(
        "index", headline=headline(site), filters=filters, policies=policies,
        best_filters=best[0], best_policies=best[1],
        n_filter_environments=sum(board.category == "filter" and board.environment in together
                                  for board in site.boards),
        moving=site.address(HEADLINE[0]), still=site.address(HEADLINE[1]),
        shown=shown, about=CATEGORY_TEXTS,
        last=max(map(stored.finished_at, site.records), default="")[:10],
        explanations=tables.explanations(shown.values()))


def headline(site: Site) -> dict[str, Any] | None:
    """Return the board of the first page, errors ẽ_c of methods on it, the best filter that ran in
    all environments, and the ratio, rounded down, of the error of stationary images to its error;
    None without official records of these."""
    board, every = (site.board("filter", name) for name in (HEADLINE_ENVIRONMENT, ALL))
    best = next((row for row in (every.rows if every else ())
                 if row.is_ranked and row.cells["official"]), None)
    errors = {row.cells["method"]: row.cells["error"] for row in (board.rows if board else ())
              if row.cells["official"] and row.complete}
    if best is None or not {*HEADLINE_METHODS, best.cells["method"]} <= errors.keys():
        return None
    error = errors[best.cells["method"]]
    ratio = int(errors["gauss_newton"] / error)
    return None if ratio < 2 else {"ratio": ratio, "board": board, "errors": errors, "best": error,
                                   "filter": best.cells["title"]}


# -- environments ----------------------------------------------------------------------------------


def environment_page(site: Site, board: Leaderboard) -> bytes:
    """Return the HTML of the page of an environment."""
    id = board.records[0]["environment"]["id"]
    description, details = documentation(id)
    animation = f"media/{board.environment}.webp"
    moving = site.address(animation, "../")
    size = (site.folder / animation).stat().st_size if site.folder and moving else 0
    is_shifted = nominal_id(id) and environment_name(id, {}) == board.environment
    return site.page(
        "environment", "../", board=board, id=id, description=description, details=details,
        moving=moving, media_mb=f"{1e-6 * size:.1f} MB",
        is_shifted=is_shifted)


def documentation(id: str) -> tuple[Markup, Markup]:
    """Return the description of an id and the remaining sections of its page, as HTML."""
    text = re.sub(r"\A\s*## Description\s*", "", describe_environment(id))
    first, rest = re.split(r"^(?=## |\|)", text, maxsplit=1, flags=re.MULTILINE)
    return markdown(first), markdown(rest)


# -- methods ---------------------------------------------------------------------------------------


def method_page(site: Site, name: str) -> bytes:
    """Return the HTML of the page of all versions of a method."""
    records = sorted((record for record in site.records if record["method"] == name),
                     key=stored.precedence, reverse=True)
    placements = [(board, row) for own in site.classes.values() for board in own
                  for row in board.rows if row.cells["method"] == name]
    # agents of several environments share name and version
    versions = stored.group_by(
        records, lambda record: (record["version"], str(record["parameters"].get("env"))))
    table, axes = _placements(placements)
    # agents of several environments have no common title
    title = name if len({env for _, env in versions}) > 1 else records[0]["title"]
    return site.page(
        "method", "../", name=name, title=title, placements=table, axes=axes,
        versions=[(own, *_source(own[0])) for own in versions.values()],
        addresses={(row.cells["environment"], row.cells["version"]): board.address
                   for board, row in placements},
        episode_table=_episodes, environment_title=boards.environment_title,
        group_runs=stored.group_runs, record_file_name=stored.record_file_name,
        to_json=partial(json.dumps, ensure_ascii=False))


def _placements(placements: list[tuple[Leaderboard, MethodRow]]) -> tuple[Table, dict[str, Axis]]:
    """Return one row for each board, and the axes of skill scores that all rows share."""
    every = Leaderboard("", ALL, "", [row for _, row in placements])
    gains = tables.score_axes(every)["skill score"]
    rows = []
    for board, row in placements:
        n_ranked = sum(each.is_ranked for each in board.rows)
        link = f"../index.html#{board.anchor}" if board.is_aggregate else f"../{board.address}"
        rows.append({
            "leaderboard": Cell(board.title, board.title.casefold(), link=link,
                          note=f"{board.category} · {row.cells['version']}", badges=row.badges),
            "rank": number_cell(row.cells["rank"])._replace(
                note=f"of {n_ranked}" if row.is_ranked else ""),
            "ẽ_c": tables.interval_cell(row, "error", tables.score_axes(board)["ẽ_c"]),
            "skill score": tables.interval_cell(row, "gain", gains),
            "ms/step": number_cell(row.cells["seconds_per_step"])})
    table = Table.of(rows, label="Results", keep=list(rows[0]) if rows else ())
    return table, {"skill score": gains}


def _episodes(record: dict[str, Any]) -> Table:
    """Return one row for each episode, with the scores that any of them has."""
    values = {heading: scores_by_seed(record, name)
              for name, heading in ({"error": "ẽ_c"} | boards.headings()).items()}
    return Table.of([{
        "seed": Cell(episode["seed"], float(i)), "status": episode["status"],
        **{heading: number_cell(own.get(episode["seed"])) for heading, own in values.items()},
        "date": Cell(episode["finished"][:10], episode["finished"]),
    } for i, episode in enumerate(record["episodes"])],
        label=f"Episodes of {boards.environment_title(record)}")


def _source(record: dict[str, Any]) -> tuple[str, Markup]:
    """Return the path of a built-in method's file in this repository, and its docstring if the file
    is the recorded version, by number or by content; empty where it is not there.

    Agents must be the very version, since others may use their names.
    """
    path = builtin_files(record["environment"]["id"]).get(record["method"])
    if path is None:
        return "", Markup()
    file = f"baselines/{path.relative_to(baseline_folder()).as_posix()}"
    sha256 = builtin_sha256(path)
    if record["version"] != version_of(path, sha256) and record["method_sha256"] != sha256:
        return file if path.suffix == ".py" else "", Markup()
    text = ast.get_docstring(ast.parse(path.read_bytes())) if path.suffix == ".py" else None
    return file, markdown(text or "")
