"""Robustness leaderboard: scores in the nominal and in shifted environments.

Errors of two environments are not comparable, since strong slugs are a larger fraction of the
truth. Methods are therefore ordered by their lowest skill score.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from itertools import chain
from statistics import fmean
from typing import NamedTuple

from markupsafe import Markup

from eitbench.bench.table import MISSING, Cell, Table, number_cell
from eitbench.bench.text import format_number
from eitbench.bench.tracks import environment_name, ids, nominal_id
from eitbench.report.boards import Leaderboard, MethodRow, base_environment
from eitbench.report.tables import author_badges, filter_flags, method_cell
from eitbench.report.templates import markdown
from eitbench.worlds.registry import entry

WORSE_THAN_NAIVE = "worse than naive"
ROBUSTNESS_COLUMNS = {
    "nominal": "ẽ_c = ‖ĉ − c‖²/‖c‖² in the nominal environment, whose truth agrees with the model; "
               "mean over the episodes, dimensionless; lower is better",
    "shifted": "ẽ_c in an environment where one property of the truth differs from the model and "
               "the training episodes, and its ratio to the nominal ẽ_c",
    WORSE_THAN_NAIVE: "ẽ_c exceeds the smallest ẽ_c of a naive baseline in the same environment",
    "mean skill score": "skill score 1 − ẽ_c / ẽ_c of the naive baseline in the same environment, "
                        "mean over all shifts: 0 equals the baseline, 1 is perfect",
    "lowest skill score": "smallest skill score over the shifts, and the shift; orders the table. "
                          "Missing unless all shifts are finished. Ratios alone would favour "
                          "methods with a large nominal error",
    "oracle": "uses the true flow, but nominal noise, contacts and slugs; it is not a bound",
}
"""Heading or mark -> explanation."""


class ShiftFamily(NamedTuple):
    """A nominal world and its shifts."""

    home: str
    """id"""
    nominal: Leaderboard | None
    """None without a record"""
    shifts: dict[str, Leaderboard]
    """Heading -> board, of those with records, in the order of registration."""

    @property
    def table(self) -> Table:
        """Table by decreasing lowest skill score, unfinished methods last."""
        nominal = {row.label: row for row in self.nominal.rows} if self.nominal else {}
        shifted = {name: {row.label: row for row in board.rows}
                   for name, board in self.shifts.items()}
        floors = {name: _best_naive_error(board) for name, board in self.shifts.items()}
        lines: list[tuple[float, dict[str, Cell | str], str]] = []
        for label in dict.fromkeys(chain(*shifted.values())):
            home = nominal.get(label)
            own = {name: rows[label] for name, rows in shifted.items() if label in rows}
            gains = {name: row.cells["gain"] for name, row in own.items()
                     if row.complete and row.cells["gain"] is not None}
            row = home or next(iter(own.values()))
            least = min(gains, key=gains.__getitem__) if gains.keys() == shifted.keys() else ""
            lines.append((-gains[least] if least else math.inf, {
                "method": method_cell(row, "", author_badges(row)), "nominal": _error_cell(home),
                **{name: _error_cell(own.get(name), home, floors[name]) for name in self.shifts},
                "mean skill score": number_cell(fmean(gains.values()) if least else None),
                "lowest skill score": number_cell(gains.get(least))._replace(note=least),
            }, filter_flags(row)))
        lines.sort(key=lambda line: line[0])
        return Table.of([cells for _, cells, _ in lines], keep=["nominal"],
                        label=f"{base_environment(self.home)} and its shifts",
                        flags=[flag for *_, flag in lines])


def shift_families(boards: Iterable[Leaderboard]) -> list[ShiftFamily]:
    """Return the registered ids with a nominal id that have boards, grouped by it."""
    of_environment = {board.environment: board for board in boards if not board.is_aggregate}
    found: dict[str, ShiftFamily] = {}
    for id in ids():
        home = nominal_id(id)
        board = of_environment.get(environment_name(id, {}))
        if home and board:
            nominal = of_environment.get(environment_name(home, {}))
            family = found.setdefault(home, ShiftFamily(home, nominal, {}))
            family.shifts[shift_heading(id, home)] = board
    return list(found.values())


def shift_heading(id: str, home: str) -> str:
    """``eitbench/Pipe2DShortSlugs-v0`` -> ``short slugs``."""
    words = base_environment(id).removeprefix(base_environment(home)) or base_environment(id)
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", words).lower()


def shift_definition(board: Leaderboard) -> Markup:
    """Return the first paragraph of the description of a shifted environment."""
    description = entry(board.records[0]["environment"]["id"]).description
    return markdown(description.strip().split("\n\n")[0])


def _best_naive_error(board: Leaderboard) -> float:
    """Return the smallest ẽ_c of the naive baselines, official ones where they exist; else ∞."""
    floors = [row for row in board.rows if "floor" in row.badges and row.complete]
    official = [row for row in floors if row.cells["official"]]
    return min((row.cells["error"] for row in official or floors), default=math.inf)


def _error_cell(row: MethodRow | None, home: MethodRow | None = None,
                floor: float = math.inf) -> Cell:
    """Return ẽ_c, its ratio to the nominal one, and badges: worse than naive, unfinished."""
    if row is None:
        return Cell(MISSING)
    error = row.cells["error"]
    badges = [word for word in row.badges if "failed" in word or "missing" in word]
    if error is not None and error > floor and "floor" not in row.badges:
        badges.insert(0, WORSE_THAN_NAIVE)
    ratio = ""
    if home and home.complete and row.complete and home.cells["error"]:
        ratio = f"× {format_number(error / home.cells['error'])}"
    return number_cell(error)._replace(note=ratio, badges=tuple(badges))
