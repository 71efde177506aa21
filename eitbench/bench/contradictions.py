"""What the schema of records cannot say: fields of a valid one that do not fit each other or the
environment, and numbers and names beyond what anybody needs."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from functools import lru_cache
from typing import Any

from eitbench._foreign import cleaned
from eitbench.bench import tracks
from eitbench.bench.names import faults
from eitbench.data.seeds import name_seed, parse_seeds

OURS = re.compile(r"v([1-9][0-9]*)")
"""Versions of our own methods; of all others a version is eight digits of their file's sha256."""
LARGEST, SMALLEST = 1e50, 1e-100
"""Between which the sizes of scores and times lie, if they are not zero: their ratios, and the
squares of those, are finite then."""
LONGEST_ARGUMENTS = 10_000
"""letters of an environment's arguments as JSON, which become headings"""
DIGITS = 9
"""of a version v1, v2, …"""


def contradictions(record: dict[str, Any]) -> list[str]:
    """A sentence for each, beginning with the field."""
    return [*_of_the_environment(record), *_of_the_method(record), *_of_the_seeds(record),
            *_of_the_episodes(record), *_of_the_numbers(record)]


def split_of(seed: str) -> str:
    """``test`` of ``test:4``; ``own`` of a plain number."""
    return seed.split(":")[0] if ":" in seed else "own"


def version_number(version: str) -> int | None:
    """3 of ``v3``, a version of a method of ours; None for the digits of somebody else's file."""
    return int(version[1:]) if OURS.fullmatch(version) else None


def _of_the_environment(record: dict[str, Any]) -> Iterator[str]:
    environment = record["environment"]
    id = environment["id"]
    kwargs = environment["kwargs"]
    name = tracks.named(id, kwargs)
    if environment["name"] != name:
        yield f"$.environment.name: must be {name}, as id and kwargs ask for"
    if len(json.dumps(kwargs)) > LONGEST_ARGUMENTS:
        yield f"$.environment.kwargs: must be of {LONGEST_ARGUMENTS} letters at most"
    if id not in tracks.ids():                        # nothing is known of it: nobody shows it
        return
    try:
        boards = tracks.boards_of(id, kwargs)
    except ValueError as error:
        yield f"$.environment.kwargs: {error}"
        return
    if record["board"] not in boards:
        yield f"$.board: must be {' or '.join(boards)}, as the environment asks for"


def _of_the_method(record: dict[str, Any]) -> Iterator[str]:
    version = record["version"]
    if len(version) > DIGITS + 1:
        yield f"$.version: must have {DIGITS} digits at most"
    elif version != record["method_sha256"][:8] and version_number(version) is None:
        yield "$.version: must be v1, v2, … of ours, or begin as method_sha256 does"
    yield from faults(record["method"], record["title"], record["environment"]["id"])
    if record["official"] and any(run["commit"] is None or run["dirty"] for run in record["runs"]):
        yield "$.official: must be false where a run was not of a commit without changes"


def _of_the_seeds(record: dict[str, Any]) -> Iterator[str]:
    if record["seeds"] != [episode["seed"] for episode in record["episodes"]]:
        yield "$.seeds: must be those of the episodes, in their order"
    for seed in record["seeds"]:
        if not _names_an_episode(seed):
            yield f"$.seeds: {cleaned(seed)[:40]!r} names no episode"
    if {split_of(seed) for seed in record["seeds"]} != {record["split"]}:
        yield f"$.seeds: must all be of the split {record['split']}"


def _of_the_episodes(record: dict[str, Any]) -> Iterator[str]:
    lengths = set()
    for i, episode in enumerate(record["episodes"]):
        if episode["run"] >= len(record["runs"]):
            yield f"$.episodes[{i}].run: there are only {len(record['runs'])} runs"
        if steps := episode.get("step_errors"):
            lengths.add(len(steps))
            mean = math.fsum(steps) / len(steps)
            if not math.isclose(episode["scores"]["error"], mean, rel_tol=1e-9):
                yield f"$.episodes[{i}].scores.error: must be the mean of step_errors"
    if len(lengths) > 1:
        yield "$.episodes: must have as many step_errors each"


def _of_the_numbers(record: dict[str, Any]) -> Iterator[str]:
    """Of whatever is computed with."""
    for i, run in enumerate(record["runs"]):
        if not _is_in_range(run["machine"]["matmul_seconds"]):
            yield f"$.runs[{i}].machine.matmul_seconds: {_RANGE}"
    for i, episode in enumerate(record["episodes"]):
        scores = episode.get("scores", {})
        steps = episode.get("step_errors", ())
        # most are sound, and of many numbers the ends say so
        if (all(map(_is_in_range, (*scores.values(), episode["seconds"], episode["peak_memory"])))
                and (not steps or SMALLEST <= min(steps) <= max(steps) <= LARGEST)):
            continue
        numbers = {f"scores.{name}": value for name, value in scores.items()}
        numbers |= {name: episode[name] for name in ("seconds", "peak_memory")}
        numbers |= {f"step_errors[{k}]": value for k, value in enumerate(steps)}
        for name, value in numbers.items():
            if not _is_in_range(value):
                yield f"$.episodes[{i}].{name}: {_RANGE}"
                break


_RANGE = f"must be 0 or of a size from {SMALLEST:g} to {LARGEST:g}"


def _is_in_range(value: float | None) -> bool:
    return not value or SMALLEST <= abs(value) <= LARGEST


@lru_cache(maxsize=2**14)
def _names_an_episode(seed: str) -> bool:
    """Whether it lies within its split, written as `name_seed` does: an episode has one name."""
    try:
        return name_seed(parse_seeds(seed)[0]) == seed
    except ValueError:
        return False
