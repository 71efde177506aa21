"""Cards of our methods: what each scores in one short episode, as small committed files.

A card says which version of a method its numbers are of. When code moves them the method is another
one: it gets a new version, and its records are played again.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from eitbench._files import write_atomically
from eitbench.bench import tracks
from eitbench.bench.methods import (
    baseline_folder,
    card_name,
    card_version,
    is_path,
    load_method,
    own_agents,
    own_methods,
)
from eitbench.bench.playing import Episode, can_play, environment, play
from eitbench.bench.scores import scored, scores
from eitbench.data.seeds import parse_seeds

SEED = "dev:0"
ENTRIES = 5
"""How many nodes of the last estimate a card holds."""
DOUBLE = 1e-6
SINGLE = 1e-4
"""Relative differences that are none: other processors and BLAS kernels take sums in another order;
the reduced filter computes in single precision."""

_FAST = {"flow": {"mean_velocity": 45.0},
         "schedule": {"scored_steps": 5, "pattern": {"frame": 2}},
         "vessel": {"electrodes_per_wall": 2}}
_CHOICE = {"flow": {"mean_velocity": 16.0}, "schedule": {"scored_steps": 4}}
_REAL = {"schedule": {"scored_steps": 5}}
SHORT: tuple[tuple[str, dict[str, Any]], ...] = (
    ("eitbench/Pipe2D-v0", {"world": _FAST}),
    ("eitbench/Pipe2DFixedLag-v0", {"world": _FAST, "lag": 2}),
    ("eitbench/Pipe2DSmoothing-v0", {"world": _FAST}),
    ("eitbench/StationaryTank2D-v0", {"world": {
        "vessel": {"n_electrodes": 8}, "schedule": {"scored_steps": 5}}}),
    ("eitbench/Pipe2DUnknownVelocity-v0", {"world": _FAST | {
        "flow": {"mean_velocity": 45.0, "velocity_range": [40.0, 50.0]}}}),
    ("eitbench/Pipe2DInjection-v0", {"world": _CHOICE}),
    ("eitbench/Pipe2DInjectionCurrents-v0", {"world": _CHOICE}),
    ("eitbench/Pipe2DInjectionFaults-v0", {"world": _CHOICE}),
    ("eitbench/Pipe2DInjectionBudget-v0", {"world": _CHOICE, "estimator": "reduced"}),
    ("eitbench/Pipe2DInjectionFlow-v0", {"world": _CHOICE | {
        "flow": {"mean_velocity": 16.0, "velocity_range": [15.0, 17.0]}}, "estimator": "reduced"}),
    ("eitbench/Pipe2DBiasedVelocity-v0", {"world": _REAL}),
    ("eitbench/Pipe2DFixedLag-v0", {"world": _REAL}),
    ("eitbench/Pipe2DSmoothing-v0", {"world": _REAL}),
    ("eitbench/Pipe2DObstacle-v0", {"world": _REAL}),
    ("eitbench/Pipe2DIntermittent-v0", {"world": _FAST}),
)
"""Arguments with which an episode takes a moment, since a fast fluid flushes the pipe in a few
steps; those of the real ones are for what was learned there. A method's card is of the first of
these environments that it plays."""


def card_folder() -> Path:
    """Where the cards lie."""
    return baseline_folder() / "cards"


def card_path(name: str) -> Path:
    """Of a card, by its name."""
    return card_folder() / f"{name}.json"


def official_methods() -> dict[str, str]:
    """Name of a card -> the method it is of: name, or path of the first agent of a kind."""
    agents = {card_name(Path(path)): path
              for id in tracks.ids("injection") for path in reversed(own_agents(id))}
    return {name: name for track in tracks.TRACKS for name in own_methods(track)} | agents


def read_card(name: str) -> dict[str, Any] | None:
    """A card as it is kept; None if there is none."""
    path = card_path(name)
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None


def new_card(name: str, method: str) -> dict[str, Any]:
    """What the first card of a method says, before it is played: the episode. ``ValueError`` if it
    plays none of the environments in `SHORT`."""
    for id, kwargs in SHORT:
        if _plays(method, id, kwargs):
            return {"method": name, "version": 1, "environment": id, "kwargs": kwargs, "seed": SEED,
                    "tolerance": SINGLE if kwargs.get("estimator") == "reduced" else DOUBLE}
    raise ValueError(f"method {name} plays none of the short worlds {', '.join(dict(SHORT))}")


def played(card: dict[str, Any], method: str) -> dict[str, Any]:
    """The card with what comes out now.

    ``scores`` are those of the episode that are finite and no times. ``answer`` is, of an
    estimator, some entries of its last estimate in mol/m³; of a policy, the electrodes that were
    source and sink in each step, or none.

    Raises
    ------
    ValueError
        If the method cannot play the episode.
    """
    asked = tracks.Environment(card["environment"], json.dumps(card["kwargs"]))
    (seed,) = parse_seeds(card["seed"])
    with threadpool_limits(1):  # as episodes of records are played
        episode = play(asked, load_method(method, asked.track), seed)
    numbers = scored(asked.track, episode.outcome)
    kept = {score: value for score, value in numbers.items()
            if value is not None and math.isfinite(value) and scores()[score].repeats}
    return card | {"scores": kept, "answer": _answer(episode)}


def moved(card: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """A sentence for each number of a card that is another now; new scores are no difference."""
    tolerance = card["tolerance"]
    said = []
    for score, then in card["scores"].items():
        value = now["scores"].get(score, math.nan)
        if not math.isclose(value, then, rel_tol=tolerance, abs_tol=1e-300):
            said.append(f"{score} is {now['scores'].get(score)}, the card says {then}")
    if not _same(card["answer"], now["answer"], tolerance):
        said.append(f"answer is {now['answer']}, the card says {card['answer']}")
    return said


def update(names: list[str], *, new_version: bool = False) -> Iterator[tuple[str, str, list[str]]]:
    """Play the cards of some methods (default: all of ours), and write what is new.

    Where numbers have moved the card stays as it is, unless there is to be a new version: then it
    is written with the next number.

    Yields
    ------
    name, what, differences
        ``what`` is ``new``, ``same``, ``moved``, or the new version.

    ``ValueError`` if a name is none of ours.
    """
    methods = official_methods()
    if unknown := [name for name in names if name not in methods]:
        raise ValueError(f"method must be one of {', '.join(methods)}; got {', '.join(unknown)}")
    for name in names or methods:
        yield (name, *_updated(name, methods[name], new_version))


def _updated(name: str, method: str, new_version: bool) -> tuple[str, list[str]]:
    card = read_card(name)
    now = played(card or new_card(name, method), method)
    differences = moved(card, now) if card else []
    if differences and not new_version:
        return "moved", differences
    if card and not differences:
        # Scores that came after the card was written are added; what is there stays to the bit.
        now = card | {"scores": now["scores"] | card["scores"]}
        what = "same"
    else:
        now["version"] = card["version"] + 1 if card else 1
        what = f"v{now['version']}" if card else "new"
    if now != card:
        write_atomically(card_path(name), _text(now).encode())
        card_version.cache_clear()
    return what, differences


def _plays(method: str, id: str, kwargs: dict[str, Any]) -> bool:
    asked = tracks.Environment(id, json.dumps(kwargs))
    if is_path(method):
        return Path(method).parents[2].name == id.replace("/", "-")
    if method not in own_methods(asked.track):
        return False
    return can_play(load_method(method, asked.track), environment(asked))


def _text(card: dict[str, Any]) -> str:
    """JSON with a line for each field and score, so that changes can be read line by line."""
    scores = ",\n".join(f"  {json.dumps(score)}: {value!r}"
                        for score, value in sorted(card["scores"].items()))
    lines = [f" {json.dumps(key)}: {json.dumps(value)}"
             for key, value in card.items() if key != "scores"]
    return "{\n" + ",\n".join([*lines, f' "scores": {{\n{scores}\n }}']) + "\n}\n"


def _answer(episode: Episode) -> list[Any]:
    """Some entries of the last estimate; of a policy, source and sink of each step."""
    if not episode.fields:
        return [[int(step.argmax()), int(step.argmin())] if step.any() else []
                for step in episode.currents]
    last = episode.fields["mean"][-1]
    nodes = np.linspace(0, last.size - 1, ENTRIES + 2).astype(int)[1:-1]
    return [float(last[node]) for node in nodes]


def _same(then: list[Any], now: list[Any], tolerance: float) -> bool:
    """Numbers up to the tolerance, choices exactly."""
    if len(then) != len(now) or any(isinstance(each, list) for each in then):
        return then == now
    return bool(np.allclose(now, then, rtol=tolerance, atol=0.0))
