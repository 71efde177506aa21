"""The page of an environment: its board in full, its charts, and its docstring."""

from __future__ import annotations

import re
from itertools import combinations
from typing import Any
from urllib.parse import quote

import numpy as np
from markdown_it import MarkdownIt
from markupsafe import Markup

from eitbench._files import shipped
from eitbench.bench.statistics import paired_probability_of_improvement
from eitbench.bench.tracks import home_of, named
from eitbench.envs.pages import page
from eitbench.report import charts
from eitbench.report.site.beside import Beside
from eitbench.report.site.collect import ROBUSTNESS, Board, Row, Site
from eitbench.report.site.tables import axes, explanations, more, rows_file, table, three
from eitbench.report.site.trainings import agent
from eitbench.report.templates import template

NOMINAL = ("coverage_50", "coverage_90")
CHARTED = 30
"""Methods beside and in the charts of a long board."""
MOST, TOLD = 7, 5
"""Jagged curves that can be told apart, and how many are drawn strongly where there are more."""


def environment_pages(site: Site, board: Board, beside: Beside) -> dict[str, bytes]:
    """The HTML of the page, which offers to play the animation that lies ``beside`` the site, and
    the lines of its board for which it has no room."""
    id = next(row.record["environment"]["id"] for row in board.rows if row.record)
    made = table(board, "../", compact=False)
    description, details = documentation(id)
    longer = more(made, board.environment, "../")
    lines = {} if longer is None else {
        longer.file.removeprefix("../"): rows_file(made, longer.file)}
    whole = board
    animation = f"{board.environment}.webp"
    board = board._replace(rows=_charted(board))
    html = template("site/environment.html.j2").render(
        root="../", links=beside.links("../"), season=site.season.number, board=whole, id=id,
        table=made, axes=axes(whole), more=longer,
        explanations=explanations([made]), charted=len(board.rows),
        description=description, details=details,
        front=_front(board), intervals=_intervals(board), curves=_curves(board),
        duels=_duels(board), calibration=_calibration(board), spread=_spread(board),
        learning=learning_curves(board.environment),
        moving=beside.picture(quote(animation), "../"),
        media_mb=f"{1e-6 * beside.media.get(animation, 0):.1f} MB",
        robustness=ROBUSTNESS if home_of(id) and named(id, {}) == board.environment else "",
        siblings=[other for other in site.boards
                  if other.of_class == board.of_class and not other.is_aggregate])
    return lines | {f"environments/{board.environment}.html": html.encode()}


def _charted(board: Board) -> list[Row]:
    """Whom the charts show: all, or of many the first, and floors and references."""
    if len(board.current) <= CHARTED:
        return board.current
    best = [row for row in board.current if not row.unranked][:CHARTED]
    return [row for row in board.current if row in best or row.unranked][:2 * CHARTED]


def documentation(id: str) -> tuple[Markup, Markup]:
    """What a docstring says first, and all the rest, as HTML."""
    text = re.sub(r"\A\s*## Description\s*", "", page(id))
    first, *rest = re.split(r"^(?=## )", text, flags=re.MULTILINE)
    return markdown(first), markdown("".join(rest))


def markdown(text: str) -> Markup:
    """HTML of a text with tables, whose headings come below those of the page; HTML and links in it
    are mere text."""
    reader = MarkdownIt("commonmark", {"html": False}).enable("table")
    reader.disable(["link", "image", "autolink"])
    tokens = reader.parse(text)
    for token in tokens:
        if token.type in ("heading_open", "heading_close"):
            token.tag = f"h{min(int(token.tag[1]) + 1, 6)}"
    html = reader.renderer.render(tokens, reader.options, {})
    begin = '<div class="card" tabindex="0" role="region" aria-label="table"><table>'
    return Markup(html.replace("<table>", begin).replace("</table>", "</table></div>"))


def _legend(rows: list[Row]) -> list[tuple[int, bool, str]]:
    """Colour, whether its line is dashed, and name."""
    return [(row.colour % charts.COLOURS, row.colour >= charts.COLOURS, row.cells["title"])
            for row in rows]


def _series(row: Row, values: Any, *, faint: bool = False) -> charts.Series:
    return charts.Series(row.cells["title"], row.colour, np.asarray(values), faint=faint)


def _chart(svg: str, rows: list[Row]) -> dict[str, Any] | None:
    return {"svg": Markup(svg), "legend": _legend(rows)} if rows else None


def _front(board: Board) -> dict[str, Any] | None:
    """Error over time per step."""
    rows = [row for row in board.current
            if row.cells["error"] is not None and row.cells["seconds_per_step"]]
    points = [charts.Point(row.cells["title"], row.colour, row.cells["seconds_per_step"],
                           row.cells["error"], row.competes) for row in rows]
    best = ", ".join(point.name for point in charts.optimal(points))
    axes = "time per step on one core, ms", "relative error ẽ_c"
    made = _chart(charts.front(points, *axes) if rows else "", rows)
    return made and made | {"best": best}


def _intervals(board: Board) -> dict[str, Any] | None:
    rows = [row for row in board.current if row.cells["error"] is not None]
    series = [_series(row, three(row, "error")) for row in rows]
    return _chart(charts.intervals(series, "relative error ẽ_c") if rows else "", rows)


def _curves(board: Board) -> dict[str, Any] | None:
    """Error of each scored step, the mean over the episodes."""
    found = [(row, [episode["step_errors"] for episode in row.episodes()]) for row in board.current]
    found = [(row, errors) for row, errors in found if errors and len(errors[0]) > 1]
    told = _told([row for row, _ in found])
    series = [_series(row, np.mean(errors, axis=0), faint=row not in told)
              for row, errors in found]
    longest = max((len(s.values) for s in series), default=0)
    steps = np.arange(1, longest + 1)
    made = _chart(charts.lines(steps, series, "scored state", "relative error") if series else "",
                  told)
    return made and made | {"faint": len(told) < len(found)}


def _told(rows: list[Row]) -> list[Row]:
    """Whose curves are drawn strongly: all, or of many two floors or references and the best of
    each kind of those with a rank; agents that differ by their training's seed are of one kind."""
    if len(rows) <= MOST:
        return rows
    kinds: dict[str, Row] = {}
    for row in rows:
        if row.competes:
            kinds.setdefault(agent(row.cells["method"]), row)
    unranked = [row for row in rows if row.unranked][:2]
    best = list(kinds.values())[:TOLD - len(unranked)]
    return [row for row in rows if row in unranked or row in best]


def _duels(board: Board) -> list[tuple[str, list[dict[str, Any] | None]]]:
    """Name of each method, and how often it is better than each of them, seed by seed; None against
    itself.

    ``share`` in %, ``low`` and ``high`` the ends of its 95 % interval, and whether it ``tells``: 50
    % is outside.
    """
    scores = [(row.cells["title"], {board.environment: {
        episode["seed"]: episode["scores"]["error"] for episode in row.episodes()}})
        for row in board.current]
    scores = [(name, own) for name, own in scores if own[board.environment]]
    cells: dict[tuple[int, int], dict[str, Any]] = {}
    for (i, (_, ours)), (j, (_, theirs)) in combinations(enumerate(scores), 2):
        if ours[board.environment].keys() & theirs[board.environment].keys():
            won = [100 * each for each in paired_probability_of_improvement(ours, theirs)]
            lost = [100 - won[0], 100 - won[2], 100 - won[1]]
            for place, (share, low, high) in (((i, j), won), ((j, i), lost)):
                cells[place] = {"share": share, "low": low, "high": high,
                                "tells": not low <= 50 <= high}
    return [(name, [cells.get((i, j)) for j in range(len(scores))])
            for i, (name, _) in enumerate(scores)]


def _calibration(board: Board) -> dict[str, Any] | None:
    """Observed coverage of the claimed 50 % and 90 % intervals."""
    rows = [row for row in board.current if all(row.cells[name] is not None for name in NOMINAL)]
    series = [_series(row, 100 * np.array([row.cells[name] for name in NOMINAL]))
              for row in rows]
    axes = "claimed, % of the truth within the interval", "observed, %"
    return _chart(charts.calibration(series, (50.0, 90.0), *axes) if rows else "", rows)


def _spread(board: Board) -> dict[str, Any] | None:
    """Claimed variance over squared error."""
    rows = [row for row in board.current if row.cells["spread_ratio"]]
    unknown = (-np.inf, np.inf)
    series = [_series(row, [row.cells["spread_ratio"], *unknown])
              for row in rows]
    said = "claimed variance / squared error"
    return _chart(charts.intervals(series, said, mark=1.0) if rows else "", rows)


def learning_curves(environment: str) -> dict[str, Any] | None:
    """Errors on dev episodes while our agents were trained: each training, and their mean."""
    folder = shipped("baselines") / "checkpoints" / environment
    series = []
    legend = []
    for colour, algorithm in enumerate(sorted(path for path in folder.glob("*") if path.is_dir())):
        trainings = []
        for path in sorted(algorithm.glob("seed*/evaluations.npz")):
            with np.load(path, allow_pickle=False) as stored:
                steps = stored["steps"]
                errors = stored["errors"].mean(axis=1)
            trainings.append((steps, errors))
            series.append(charts.Series(f"{algorithm.name}, {path.parent.name}", colour, errors,
                                        steps, faint=True))
        if trainings:
            shared = sorted(set.intersection(*(set(steps.tolist()) for steps, _ in trainings)))
            mean = np.mean([errors[np.searchsorted(steps, shared)]
                            for steps, errors in trainings], axis=0)
            series.append(charts.Series(f"{algorithm.name}, mean", colour, mean, np.array(shared)))
            legend.append((colour % charts.COLOURS, colour >= charts.COLOURS,
                           f"{algorithm.name}, mean of {len(trainings)}"))
    if not series:
        return None
    drawn = charts.lines(np.zeros(1), series, "steps of training", "relative error ẽ_c")
    return {"svg": Markup(drawn), "legend": legend}
