"""Records of a run: requested episodes, and episodes that a method did not finish."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from typing import Any, NamedTuple

from eitbench._sanitize import sanitize
from eitbench.bench.run import Job
from eitbench.bench.store import EpisodeStore
from eitbench.bench.text import seed_ranges
from eitbench.data.seeds import format_seed
from eitbench.report.boards import restrict


class Failure(NamedTuple):
    """One error of a method in some episodes of a record."""

    record: dict[str, Any]
    seeds: list[str]
    message: str
    traceback: str
    """Lines of the method's own code; empty if the error was raised elsewhere."""

    def __str__(self) -> str:
        environment = self.record["environment"]["id"]
        where = f"{self.record['method']} in {environment} on {seed_ranges(self.seeds)}"
        return f"failed: {where}: {sanitize(self.message)}" + (
            "\n" + textwrap.indent(self.traceback.rstrip(), "  ") if self.traceback else "")


def select_requested(records: Iterable[dict[str, Any]], jobs: Iterable[Job],
                     ) -> list[dict[str, Any]]:
    """Return the records restricted to the episodes of these jobs."""
    asked: dict[tuple[str, str], set[str]] = {}
    for job in jobs:
        name = job.environment.name, job.load().name
        asked.setdefault(name, set()).add(format_seed(job.seed))
    found = (restrict(record, asked.get((record["environment"]["name"], record["method"]), ()))
             for record in records)
    return [record for record in found if record["episodes"]]


def failures(store: EpisodeStore, records: Iterable[dict[str, Any]]) -> list[Failure]:
    """Return the failures of records of a store, in their order."""
    found = []
    for record in records:
        seeds: dict[tuple[str, str], list[str]] = {}
        for episode in record["episodes"]:
            if episode["status"] != "ok":
                error = episode["message"], store.traceback(record, episode["seed"])
                seeds.setdefault(error, []).append(episode["seed"])
        found += [Failure(record, those, *error) for error, those in seeds.items()]
    return found
