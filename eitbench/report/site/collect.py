"""From the table of the boards to what the pages have in common: boards with their rows, names, and
addresses."""

from __future__ import annotations

from typing import Any, NamedTuple
from urllib.parse import quote

import pandas as pd

from eitbench.bench.records import newest
from eitbench.data.seasons import Season, current_season, season_of
from eitbench.data.seeds import name_seed, parse_seeds
from eitbench.report.boards import ALL, boards

ROBUSTNESS = "robustness.html"
"""The page of the robustness board within the site."""
MEASURED = "measured.html"
"""The page of the measured board."""


class Row(NamedTuple):
    """A method on a board."""

    cells: dict[str, Any]
    """Of `boards.fields`; None where there is nothing."""
    record: dict[str, Any] | None
    """None in an aggregate."""
    outdated: bool
    colour: int
    """The same wherever the board is drawn."""

    @property
    def label(self) -> str:
        """Name and version."""
        return f"{self.cells['method']}@{self.cells['version']}"

    @property
    def competes(self) -> bool:
        """Whether it has a rank."""
        return self.cells["rank"] is not None

    @property
    def unranked(self) -> bool:
        """A floor, a reference, or shown the truth; not one that merely failed."""
        return any(word in self.cells["note"] for word in ("floor", "reference", "privileged"))

    @property
    def complete(self) -> bool:
        """Whether it has finished every episode."""
        return not any(word in self.cells["note"] for word in ("failed", "missing"))

    @property
    def badges(self) -> tuple[str, ...]:
        """Words that mark it: why it has no rank, and that it is outdated."""
        return (*filter(None, self.cells["note"].split(", ")), *["outdated"] * self.outdated)

    def episodes(self) -> list[dict[str, Any]]:
        """Those finished, of the board's seeds."""
        seeds = {name_seed(seed) for seed in parse_seeds(self.cells["seeds"])}
        return [episode for episode in (self.record or {"episodes": []})["episodes"]
                if episode["status"] == "ok" and episode["seed"] in seeds]


class Board(NamedTuple):
    """One environment, or all of a class together."""

    of_class: str
    environment: str
    title: str
    rows: list[Row]
    """Best first, the outdated ones last."""

    @property
    def is_aggregate(self) -> bool:
        return self.environment == ALL

    @property
    def current(self) -> list[Row]:
        """Without the outdated ones."""
        return [row for row in self.rows if not row.outdated]

    @property
    def seeds(self) -> str:
        """Its episodes, as whoever has played most of them has them; those of outdated rows only
        where there are no others."""
        return str(max((row.cells["seeds"] for row in self.current or self.rows),
                       key=lambda seeds: len(parse_seeds(seeds))))

    @property
    def address(self) -> str:
        """Of its page within the site."""
        return f"environments/{quote(self.environment)}.html"

    @property
    def anchor(self) -> str:
        """Of its table in the index."""
        return f"board-{self.of_class}-{self.environment}"


class Site(NamedTuple):
    """All that the pages are made of."""

    boards: list[Board]
    """Class by class, the aggregate before the environments."""
    records: list[dict[str, Any]]

    @property
    def season(self) -> Season:
        """Whose test episodes were played; the current one where nothing was."""
        split = self.records[0]["split"] if self.records else ""
        return season_of(split) or current_season()

    @property
    def classes(self) -> list[str]:
        """Those that have boards, in order."""
        return list(dict.fromkeys(board.of_class for board in self.boards))

    @property
    def methods(self) -> list[str]:
        """Names, sorted."""
        return sorted({record["method"] for record in self.records})


def collect(records: list[dict[str, Any]], table: pd.DataFrame) -> Site:
    """Boards of all records, the outdated ones among them, from the table of those that are not."""
    by_key = {(record["environment"]["name"], record["method"], record["version"]): record
              for record in records}
    found: dict[tuple[str, str], list[Row]] = {}
    for generation, rows in enumerate(_generations(records, table)):
        for cells in rows.astype(object).where(rows.notna(), None).to_dict("records"):
            # what is outdated is not put together any more
            if generation and cells["environment"] == ALL:
                continue
            board = found.setdefault((cells["class"], cells["environment"]), [])
            record = by_key.get((cells["environment"], cells["method"], cells["version"]))
            changes = {"rank": None} if generation else {}
            shown = {str(key): value for key, value in cells.items()} | changes
            board.append(Row(shown, record, generation > 0, len(board)))
    titles = {record["environment"]["name"]: title_of(record) for record in records}
    titles[ALL] = "All environments"
    made = [Board(*key, titles[key[1]], rows) for key, rows in found.items()]
    classes = list(dict.fromkeys(board.of_class for board in made))
    made.sort(key=lambda board: (classes.index(board.of_class), not board.is_aggregate))
    return Site(made, sorted(records, key=lambda record: (
        record["environment"]["name"], record["method"], record["version"])))


def title_of(record: dict[str, Any]) -> str:
    """Of its environment: the id without the prefix, and what it was given if its name says that it
    was."""
    environment = record["environment"]
    if environment["name"] == environment["id"].replace("/", "-"):
        return environment["id"].removeprefix("eitbench/")
    given = [f"{key}={value}" for key, value in environment["kwargs"].items() if value is not None]
    return f"{environment['id'].removeprefix('eitbench/')} ({', '.join(given)})"


def about_season(season: Season) -> str:
    """Which one, and who could know its episodes."""
    if season.number == 1:
        return "Season 1: anybody could simulate its test episodes from the beginning."
    return (f"Season {season.number}, begun on {season.begun}: before that day nobody but the "
            "maintainers could simulate its test episodes.")


def method_address(name: str) -> str:
    """Of a method's page within the site."""
    return f"methods/{quote(name)}.html"


def _generations(records: list[dict[str, Any]], table: pd.DataFrame) -> list[pd.DataFrame]:
    """The table, then one of what is outdated, one of what is older still, and so on: each method
    in one version."""
    tables = [table]
    left = newest(records)[1]
    while left:
        current, older = newest(left)
        tables.append(boards(current))
        left = older
    return tables
