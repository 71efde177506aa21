"""The worlds that can be played, by ids: ours, those of installed packages, those of a script."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from typing import Any

import gymnasium as gym

from eitbench import _check
from eitbench.worlds.world import World

GROUP = "eitbench.worlds"
"""Entry points of installed packages: modules that call `register` when they are imported."""
CLASSES = {
    "estimation": ("eitbench.envs.estimation:EstimationEnv",
                   "eitbench.envs.estimation:EstimationVectorEnv"),
    "injection": ("eitbench.envs.injection:InjectionEnv",
                  "eitbench.envs.injection:InjectionVectorEnv")}
"""Track -> its environment, one at a time and vectorised."""
SETTINGS = {"estimation": ("lag", "assume"), "injection": ("gate", "inflow")}
"""Track -> what an id may fix of its environment, beside the world."""


@dataclass(frozen=True)
class Entry:
    """A registered id: which world is played, and what is asked."""

    id: str
    """``namespace/Name-vN``"""
    world: World
    track: str
    """estimation or injection"""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """of the environment, JSON-ready; one of `SETTINGS`"""
    about: str = ""
    """Markdown: what the page of the environment says first"""
    seeds: str = "test:0-9"
    """the episodes of its board"""
    home: str = ""
    """the id whose task estimators get here too, though the truth is another; empty: its own"""


_entries: dict[str, Entry] = {}
_by_hand: set[str] = set()
"""Ids that neither we nor an installed package registered: other processes must be told of them."""


def register(world: World, id: str, *, track: str = "estimation", about: str = "",
             seeds: str = "test:0-9", home: str = "", **settings: Any) -> None:
    """Make a world playable under an id, for `gymnasium.make` and for everything here.

    ``ValueError`` if the id has another form or belongs to another world, a setting is unknown, or
    estimators are told something else than at ``home``.

    Parameters
    ----------
    world : World
    id : str
        ``namespace/Name-vN``. Other numbers are another version.
    track : "estimation" or "injection"
        Whether the agent says what the concentration is, or what to inject next.
    about : str
        Markdown, for the environment's page.
    seeds : str
        The test episodes of its board.
    home : str
        Of a shift: the registered id whose task estimators get here too, though the truth is
        another. The robustness board compares the two, and quotes the first paragraph of ``about``.
    settings
        Of the environment: ``lag`` and ``assume`` for estimates, ``gate`` and ``inflow`` for
        injections.
    """
    if not re.fullmatch(r"[\w.-]+/[\w.-]+-v\d+", id):
        raise ValueError(f"id must look like 'namespace/Name-v0', got {id!r}")
    if track not in CLASSES:
        raise ValueError(f"track must be one of {', '.join(CLASSES)}, got {track!r}")
    if unknown := sorted(set(settings) - set(SETTINGS[track])):
        raise ValueError(f"settings of the track {track} are {', '.join(SETTINGS[track])}; "
                         f"got {', '.join(unknown)}")
    try:
        json.dumps(settings, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"settings must be fit for JSON: {error}") from None
    entry = Entry(id, world, track, settings, about, seeds, home)
    if home:
        _check_home(entry)
    taken = _entries[id] != entry if id in _entries else id in gym.registry
    if taken:
        raise ValueError(f"id {id} belongs to another world already; take another name or version")
    _entries[id] = entry
    _by_hand.add(id)
    _make_known(entry)


def _check_home(shifted: Entry) -> None:
    """``ValueError`` unless estimators are told of this world what they are told at its home."""
    home = _entries.get(shifted.home)
    if home is None or home.home:
        raise ValueError("home must be a registered id that is no shift itself, "
                         f"got {shifted.home!r}")
    here, there = _told(shifted), _told(home)
    if other := [name for name in here if here[name] != there[name]]:
        raise ValueError(f"home must be an id of which estimators are told the same; {shifted.id} "
                         f"and {home.id} differ in {', '.join(other)}")


def _told(entry: Entry) -> dict[str, Any]:
    """Numbers that estimators are told; beside them what is believed of the flow."""
    world = entry.world
    return {"track": entry.track, "settings": dict(entry.settings), "vessel": world.vessel,
            "schedule": world.schedule, "steps": (world.n_steps, world.warm_up),
            "noise": world.instrument.believed_noise, "current": world.instrument.current,
            "prior": world.prior}


def _make_known(entry: Entry) -> None:
    """To `gymnasium.make`."""
    if entry.id not in gym.registry:
        single, many = CLASSES[entry.track]
        gym.register(entry.id, entry_point=single, vector_entry_point=many,
                     kwargs={"name": entry.id})


def entries() -> dict[str, Entry]:
    """All of them by id, in the order in which they were registered."""
    return dict(_entries)


def entry(id: str) -> Entry:
    """The entry of this id; ``ValueError`` naming all, if there is none."""
    if id not in _entries:
        raise ValueError(f"env must be one of {', '.join(_entries)}; got {id!r}"
                         + _check.nearest(id, _entries))
    return _entries[id]


def registered_by_hand() -> list[Entry]:
    """Entries that another process does not know by itself."""
    return [_entries[id] for id in sorted(_by_hand)]


def take_over(told: list[Entry]) -> None:
    """Register what another process has registered by hand, in place of what had its id here."""
    for each in told:
        gym.registry.pop(each.id, None)
        _entries[each.id] = each
        _by_hand.add(each.id)
        _make_known(each)


def register_installed() -> None:
    """Register the worlds of installed packages; one that fails is left out with a warning."""
    for point in entry_points(group=GROUP):
        try:
            point.load()
        except Exception as error:          # somebody else's package must not break ours
            warnings.warn(f"worlds of {point.value} are left out: {type(error).__name__}: {error}",
                          stacklevel=2)
    _by_hand.clear()
