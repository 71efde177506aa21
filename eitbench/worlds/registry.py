"""Registry of environments: built-in ids, ids of installed packages and ids of a script."""

from __future__ import annotations

import csv
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import gymnasium as gym

from eitbench import _check
from eitbench.worlds.world import World

ENV_CLASSES = {
    "estimation": ("eitbench.envs.estimation:EstimationEnv",
                   "eitbench.envs.estimation:EstimationVectorEnv"),
    "injection": ("eitbench.envs.injection:InjectionEnv",
                  "eitbench.envs.injection:InjectionVectorEnv")}
"""Track -> its environment and its vector environment."""
ID_SETTINGS = {"estimation": ("lag", "assume"),
               "injection": ("gate", "inflow", "faults", "history")}
"""Track -> arguments of its environment that an id may fix, besides the world."""
MAX_SETTINGS_BYTES = 10_000
GROUPS = ("thesis examples", "extensions", "robustness variants", "injection", "user-defined")
"""Groups of ids in lists of environments."""
RETURNS = list(csv.DictReader(Path(__file__).with_name("returns.csv").read_text().splitlines()))
"""Rows of the file that ``studies/returns.py`` writes."""


@dataclass(frozen=True)
class Entry:
    """A registered id: its world and its task."""

    id: str
    """``namespace/Name-vN``"""
    world: World
    track: str
    """kind of the actions: estimates of the concentration (estimation), or the next injection"""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """of the environment, JSON-ready; keys from `ID_SETTINGS`"""
    description: str = ""
    """Markdown at the beginning of the environment's page"""
    test_seeds: str = "test:0-9"
    """episodes of its leaderboard"""
    nominal: str = ""
    """id of the nominal environment if this one is shifted: same task, other ground truth. The
    robustness table compares the two and quotes the first paragraph of ``description``"""
    group: str = "user-defined"
    """one of `GROUPS`"""
    is_starting_point: bool = False
    """whether new users should begin with this environment"""
    is_reference: bool = False
    """whether no known policy is better than fixed injections: its leaderboard is on its page only,
    and its scores are not in aggregates"""

    @property
    def variant(self) -> str:
        """Name of a shifted environment among the variants of its nominal one."""
        name, nominal = (id.split("/")[-1].rpartition("-v")[0] for id in (self.id, self.nominal))
        words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "-", name.removeprefix(nominal))
        return words.lower() if nominal else ""


_entries: dict[str, Entry] = {}
_runtime_ids: set[str] = set()
"""Ids that a script registered, not this or an installed package: other processes need them."""


def register(world: World, id: str, *, track: str = "estimation", description: str = "",
             test_seeds: str = "test:0-9", nominal: str = "", group: str = "user-defined",
             is_starting_point: bool = False, is_reference: bool = False,
             **settings: Any) -> None:
    """Register a world under an id ``namespace/Name-vN``, for `gymnasium.make` and for runs.

    A world with other numbers needs another version. The arguments are the fields of `Entry`;
    ``settings`` are ``lag`` and ``assume`` of estimation, ``gate``, ``inflow`` and ``faults`` of
    injection. ``ValueError`` if the id has another form or belongs to another world, a setting is
    unknown, or ``nominal`` has another task.
    """
    if not re.fullmatch(r"[\w.-]+/[\w.-]+-v\d+", id):
        raise ValueError(f"id must look like 'namespace/Name-v0', got {id!r}")
    _check.choice("track", track, ENV_CLASSES)
    _check.choice("group", group, GROUPS)
    if unknown := sorted(set(settings) - set(ID_SETTINGS[track])):
        raise ValueError(f"settings of the track {track} must be among "
                         f"{', '.join(ID_SETTINGS[track])}; got {', '.join(unknown)}")
    _check.json_object("settings", settings, MAX_SETTINGS_BYTES)
    entry = Entry(id, world, track, settings, description, test_seeds, nominal, group,
                  is_starting_point, is_reference)
    if entry.nominal:
        _check_same_task(entry)
    taken = _entries[id] != entry if id in _entries else id in gym.registry
    if taken:
        raise ValueError(f"id {id} belongs to another world already; take another name or version")
    _add(entry)


def _check_same_task(shifted: Entry) -> None:
    """Raise ``ValueError`` unless a shifted environment has the task of its nominal one."""
    nominal = _entries.get(shifted.nominal)
    if nominal is None or nominal.nominal:
        raise ValueError("nominal must be a registered id that is not shifted itself, "
                         f"got {shifted.nominal!r}")
    own, expected = ({  # all values that the task specifies apart from the assumed flow
        "track": each.track, "settings": dict(each.settings), "vessel": each.world.vessel,
        "schedule": each.world.schedule, "steps": (each.world.n_steps, each.world.warm_up),
        "noise": each.world.instrument.model_noise, "current": each.world.instrument.current,
        "prior": each.world.prior} for each in (shifted, nominal))
    if different := [name for name in own if own[name] != expected[name]]:
        raise ValueError(f"nominal must be an id with the same task; {shifted.id} and {nominal.id} "
                         f"differ in {', '.join(different)}")


def _add(entry: Entry) -> None:
    """Add an entry, here and to `gymnasium.make`."""
    _entries[entry.id] = entry
    _runtime_ids.add(entry.id)
    if entry.id not in gym.registry:
        single, vector = ENV_CLASSES[entry.track]
        returns = [float(row["mean"]) for row in published_returns(entry.id)
                   if row["group"] in ("open loop", "adaptive")]      # of hand-written policies
        gym.register(entry.id, entry_point=single, vector_entry_point=vector,
                     reward_threshold=max(returns, default=None), kwargs={"name": entry.id})


def published_returns(id: str) -> list[dict[str, str]]:
    """Return rows of an injection environment with the best random, open-loop, adaptive and trained
    policy: group, policy, mean return over dev:0-31 with the reduced filter, and half the width of
    its 95 % interval."""
    return [row for row in RETURNS if row["environment"] == id]


def entries() -> dict[str, Entry]:
    """Return all entries by id, in the order of registration."""
    return dict(_entries)


def entry(id: str, variant: str | None = None) -> Entry:
    """Return the entry of an id, or of the id's ``variant``; ``ValueError`` if it is unknown."""
    _check.choice("env", id, _entries)
    if variant is None:
        return _entries[id]
    shifted = [each for each in _entries.values() if each.nominal == id]
    if not shifted:
        raise ValueError(f"{id} has no variants, got {variant!r}")
    _check.choice(f"variant of {id}", variant, [each.variant for each in shifted])
    return next(each for each in shifted if each.variant == variant)


def runtime_entries() -> list[Entry]:
    """Return the entries that a script registered, which another process does not have."""
    return [_entries[id] for id in sorted(_runtime_ids)]


def import_entries(imported: list[Entry]) -> None:
    """Register entries of another process; they replace entries with the same id."""
    for each in imported:
        gym.registry.pop(each.id, None)
        _add(each)


def register_installed() -> None:
    """Import modules that installed packages name as entry points, and that call `register`; skip a
    package that fails with a warning."""
    for point in entry_points(group="eitbench.worlds"):
        try:
            point.load()
        except Exception as error:          # a third-party package must not break this one
            warnings.warn(f"worlds of {point.value} are left out: {type(error).__name__}: {error}",
                          stacklevel=2)
    _runtime_ids.clear()
