"""Boards, records and addresses that the pages of the site share."""

from __future__ import annotations

from typing import Any, NamedTuple

from eitbench.bench.records import newest
from eitbench.report.boards import leaderboards
from eitbench.report.model import Board

ROBUSTNESS = "robustness.html"
"""Address of the robustness board within the site."""
MEASURED = "measured.html"
"""Address of the measured board."""


class Site(NamedTuple):
    """Contents of all pages."""

    boards: list[Board]
    """Class by class, each followed by its aggregate."""
    records: list[dict[str, Any]]
    """Sorted; superseded ones included."""

    @property
    def classes(self) -> dict[str, list[Board]]:
        """Class -> its boards, the aggregate first."""
        found: dict[str, list[Board]] = {}
        for board in sorted(self.boards, key=lambda board: not board.is_aggregate):
            found.setdefault(board.of_class, []).append(board)
        return {name: found[name] for name in dict.fromkeys(each.of_class for each in self.boards)}

    @property
    def outdated(self) -> list[dict[str, Any]]:
        """Records of earlier versions of built-in methods."""
        return newest(self.records)[1]

    def board(self, of_class: str, environment: str) -> Board | None:
        """Return one of the boards, if there is one."""
        return next((board for board in self.boards
                     if (board.of_class, board.environment) == (of_class, environment)), None)


def collect(records: list[dict[str, Any]]) -> Site:
    """Return the site of the records."""
    return Site(leaderboards(records), sorted(records, key=lambda record: (
        record["environment"]["name"], record["method"], record["version"])))

