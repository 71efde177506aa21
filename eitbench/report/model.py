"""Rows and boards of leaderboards, their columns, and the names of environments."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import Any, NamedTuple
from urllib.parse import quote

from eitbench.bench.records import finished, version_number
from eitbench.bench.scores import scores
from eitbench.bench.text import seed_ranges
from eitbench.bench.tracks import FLOORS, ids, named, track_of_board
from eitbench.bench.tracks import class_of as class_of_board
from eitbench.bench.variants import as_typed, flat

ALL = "all"
"""Name of the environment in the rows of an aggregate."""
IDENTITY = ("class", "environment", "method", "version", "title", "rank", "note", "official",
             "seeds")
_NOT_THE_WORLD = ("lag", "assume", "gate", "inflow", "episodes", "render_mode", "observation",
                  "estimator")
"""Arguments of an environment that leave its true episodes unchanged."""
_GAIN = ("gain", "1 − ẽ_c / ẽ_c of the floor (homogeneous; random_pair) in the same episode: 0 as "
         "the floor, 1 perfect. Interquartile mean with its 95 % bootstrap interval")
_SKILL = ("skill", "(E_h − E) / (E_h − E_s): 0 for the homogeneous estimate, 1 for the "
          "fixed-interval smoother with the true flow, both from the whole record where the "
          "environment has such a board, so that filters may fall below 0. With †, where these two "
          "have no record of the same episodes: 1 − contrast")
COSTS = {
    "matmuls_per_step": (
        "products/step", "time per step in units of a 1000 × 1000 × 1000 matrix product on one "
        "thread of that processor, the median of all that were timed on it"),
    "peak_memory": ("MB", "peak memory of the method's process"),
}
_RANK = ("1 + the number of methods that are significantly better; shared where the difference is "
         "not significant. Floors, references, privileged methods and those that have not finished "
         "every episode have none")


class Row(NamedTuple):
    """One method on a board."""

    cells: dict[str, Any]
    """Values of `fields`; None where there is no value."""
    record: dict[str, Any] | None = None
    """Restricted to the board's episodes; None in an aggregate."""
    gains: dict[str, float] = {}  # noqa: RUF012 (never changed)
    """Seed -> gain over the floor; empty without a floor."""
    colour: int = 0

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
        """Whether it is a floor, a reference or privileged, finished or not."""
        return any(word in self.cells["note"] for word in ("floor", "reference", "privileged"))

    @property
    def complete(self) -> bool:
        """Whether it has finished every episode."""
        return not any(word in self.cells["note"] for word in ("failed", "missing"))

    @property
    def badges(self) -> tuple[str, ...]:
        """Reasons for having no rank."""
        return tuple(filter(None, self.cells["note"].split(", ")))

    def episodes(self) -> list[dict[str, Any]]:
        """Return the finished episodes."""
        episodes = self.record["episodes"] if self.record else []
        return [episode for episode in episodes if episode["status"] == "ok"]

    def three(self, name: str) -> tuple[float, float, float]:
        """Return a score and the ends of its interval; NaN and infinite where unknown."""
        value, low, high = (self.cells[key] for key in (name, f"{name}_low", f"{name}_high"))
        return (math.nan if value is None else value, -math.inf if low is None else low,
                math.inf if high is None else high)


class Board(NamedTuple):
    """One environment, or the aggregate of a class."""

    of_class: str
    environment: str
    title: str
    rows: list[Row]
    """Best first."""

    @property
    def is_aggregate(self) -> bool:
        return self.environment == ALL

    @property
    def seeds(self) -> str:
        """Seeds of all rows together."""
        records = [row.record for row in self.rows if row.record]
        seeds = {seed for record in records for seed in record["seeds"]}
        return seed_ranges(sorted(seeds)) if seeds else ""

    @property
    def address(self) -> str:
        """Address of its page within the site."""
        return f"environments/{quote(self.environment)}.html"

    @property
    def anchor(self) -> str:
        """Identifier of its table in the index."""
        return f"board-{self.of_class}-{self.environment}"


def method_address(name: str) -> str:
    """Return the address of the page of a method within the site."""
    return f"methods/{quote(name)}.html"


def columns(*, measured: bool = False) -> dict[str, tuple[str, str]]:
    """Return name -> heading and explanation of each number: registered scores, gain, skill and
    costs; with ``measured`` also the scores of measurements."""
    known = scores() | (scores("measured") if measured else {})
    each = {name: (score.heading, score.explanation) for name, score in known.items()}
    heading, text = each.pop("error")
    text += "; mean over the episodes with its 95 % interval; lower is better"
    return {"error": (heading, text), "gain": _GAIN, "skill": _SKILL} | each | COSTS


def headings(*, measured: bool = False) -> dict[str, str]:
    """Return column -> heading of all numbers without an interval."""
    return {name: heading for name, (heading, _) in columns(measured=measured).items()
            if name not in ("error", "gain")}


def meanings(*, measured: bool = False) -> dict[str, str]:
    """Return heading -> explanation."""
    return {"rank": _RANK} | dict(columns(measured=measured).values())


def fields() -> list[str]:
    """Return the columns of leaderboard.csv."""
    ends = [f"{name}{end}" for name in ("error", "gain") for end in ("", "_low", "_high")]
    return [*IDENTITY, *ends, *headings()]


def class_of(record: dict[str, Any]) -> str:
    """Return the class in `CLASSES` of a record."""
    return class_of_board(record["environment"]["id"], record["board"])


def floor_of(records: Iterable[dict[str, Any]]) -> dict[str, Any] | None:
    """Return the record from which gains are counted, of those of one environment, if any."""
    return max(filter(is_floor, records), default=None,
               key=lambda record: (record["official"], finished(record)))


def is_floor(record: dict[str, Any]) -> bool:
    """Return whether it is a record of the built-in floor: third-party versions are no numbers."""
    return (record["method"] == FLOORS[track_of_board(record["board"])]
            and version_number(record["version"]) is not None)


def kind_of(id: str) -> str:
    """``eitbench/Pipe2DSmoothing-v0`` -> ``Pipe2D``."""
    name = re.sub(r"(FixedLag|Smoothing)(?=(-v\d+)?$)", "", id)
    return name.removeprefix("eitbench/").removesuffix("-v0")


def world(record: dict[str, Any]) -> str:
    """Return the name of what environments with the same true episodes share: ``Pipe2D
    (scored_steps=3)``."""
    environment = record["environment"]
    changed = {key: value for key, value in environment["kwargs"].items()
               if key not in _NOT_THE_WORLD}
    return kind_of(environment["id"]) + _arguments(changed)


def title_of(record: dict[str, Any]) -> str:
    """Return the environment's id without its prefix, and its arguments."""
    environment = record["environment"]
    given = {} if environment["name"] == named(environment["id"], {}) else environment["kwargs"]
    return environment["id"].removeprefix("eitbench/") + _arguments(given)


def _arguments(kwargs: dict[str, Any]) -> str:
    """`` (flow.mean_velocity=45.0, lag=3)``, or nothing."""
    given = {key: value for key, value in kwargs.items() if value is not None}
    flattened = flat(given | given.pop("world", {}))
    texts = [f"{key}={as_typed(value)}" for key, value in sorted(flattened.items())]
    return f" ({', '.join(texts)})" if texts else ""


def place_of_world(name: str) -> tuple[int, str]:
    """Return the place of a world: in the order of registration, then unregistered ones."""
    kinds = [kind_of(id) for id in ids()]
    kind = name.split(" (")[0]
    return kinds.index(kind) if kind in kinds else len(kinds), name
