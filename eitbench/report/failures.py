"""Episodes that a method did not finish, those together that ended in the same way."""

from __future__ import annotations

import json
import shlex
import textwrap
from collections.abc import Iterable
from typing import Any, NamedTuple

from eitbench._foreign import cleaned
from eitbench.bench.run import Job
from eitbench.bench.store import EpisodeStore
from eitbench.bench.text import seed_ranges
from eitbench.bench.variants import as_typed, flat
from eitbench.data.seeds import name_seed


class Failure(NamedTuple):
    """What a method did wrong in some episodes of a record."""

    record: dict[str, Any]
    seeds: list[str]
    """In the record's order."""
    message: str
    traceback: str
    """The lines of the method's own code that led to it; empty where it was not its code."""

    def __str__(self) -> str:
        environment = self.record["environment"]["id"]
        who = f"{self.record['method']} in {environment} on {seed_ranges(self.seeds)}"
        return f"failed: {who}: {cleaned(self.message)}" + (
            "\n" + textwrap.indent(self.traceback.rstrip(), "  ") if self.traceback else "")


def failures(store: EpisodeStore, records: Iterable[dict[str, Any]]) -> list[Failure]:
    """Those of records that were gathered from a store, in their order."""
    found = []
    for record in records:
        tracebacks = store.tracebacks(record)
        seeds: dict[tuple[str, str], list[str]] = {}
        for episode in record["episodes"]:
            if episode["status"] != "ok":
                how = episode["message"], tracebacks[episode["seed"]]
                seeds.setdefault(how, []).append(episode["seed"])
        found += [Failure(record, those, *how) for how, those in seeds.items()]
    return found


_COMMANDS = {"estimation": ("run", "--baseline"), "injection": ("policies", "--policy")}
"""Track -> the command that plays its methods, and the option that names them."""


def debugging(failure: Failure, asked: Iterable[Job]) -> str:
    """The command that plays the first of these episodes in its own process, where nothing hides
    truth and files from the method; empty if it was not asked for."""
    first = failure.seeds[0]
    failed = (failure.record["environment"]["name"], failure.record["method"], first)
    for job in asked:
        if (job.environment.name, job.load().name, name_seed(job.seed)) == failed:
            command, option = _COMMANDS[job.environment.track]
            given = json.loads(job.environment.kwargs)
            changes = [f"--set={number}={as_typed(value)}"
                       for number, value in flat(given.get("world", {})).items()]
            estimator = ["--estimator", given["estimator"]] if "estimator" in given else []
            return shlex.join(["eitbench", command, "--env", job.environment.id, option, job.method,
                               "--seeds", first, *changes, *estimator, "--isolate", "none",
                               "--jobs", "1"])
    return ""
