"""Methods whose code runs in a guest, in the form of any other: loading one executes nothing here.

A process has one guest at a time. It plays the episodes of one method in one environment, one after
the other.
"""

from __future__ import annotations

import atexit
import hashlib
import json
import re
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from eitbench.bench.baselines import BOARDS, ROLES, Baseline, find_baseline, is_ours, load_baseline
from eitbench.bench.policies import PolicyFile, find_policy, load_policy, own_agents, own_policies
from eitbench.bench.sandbox.host import Guest, GuestError

NAME = re.compile(r"[^./\\][^/\\]*")
"""Of a method, as records have it."""
_present: list[tuple[tuple[str, ...], Guest]] = []
"""The guest of this process, and whom it plays."""


def load(kind: str, id: str, kwargs: str, method: str) -> Baseline | PolicyFile:
    """An "estimator" or a "policy", by name or path, for an environment with these arguments
    (JSON).

    Raises
    ------
    ValueError
        If there is no such file, it cannot be loaded, or it asks for the truth, which a guest has
        not.
    """
    path = (find_baseline if kind == "estimator" else find_policy)(method)
    if is_ours(method):  # what it says of itself need not be asked of a guest
        return _ours(kind, id, kwargs, method, path)
    return _load(kind, id, kwargs, method, path, hashlib.sha256(path.read_bytes()).hexdigest())


def peak_memory() -> int | None:
    """Bytes that the present guest has held at most."""
    return _present[0][1].peak_memory if _present else None


def close() -> None:
    """End the present guest."""
    while _present:
        _present.pop()[1].close()


class _Elsewhere:
    """Stands for a method's class: to make one is to begin an episode in the guest, which then
    answers."""

    def __init__(self, enter: Callable[[], Guest], suits: Callable[[Any], bool]) -> None:
        self._enter = enter
        self.suits = suits
        """world -> whether it can play there"""

    def __call__(self, world: Any, random: np.random.Generator | None = None) -> Guest:
        guest = self._enter()
        guest.begin(0 if random is None else random.bit_generator.seed_seq.entropy)  # type: ignore[attr-defined]
        return guest


def _ours(kind: str, id: str, kwargs: str, method: str, path: Path) -> Baseline | PolicyFile:
    """One of ours: loaded here, played in a guest."""
    loaded = load_baseline(method) if kind == "estimator" else load_policy(method)
    if loaded.privileged:
        raise ValueError(f"{path} is privileged: it asks for the truth, which a process of its own has not")
    there = _Elsewhere(partial(_enter, kind, id, kwargs, method, loaded.sha256), loaded.suits)
    return (loaded._replace(estimator=there) if isinstance(loaded, Baseline)
            else loaded._replace(policy=cast(Any, there)))


@lru_cache(maxsize=64)
def _load(kind: str, id: str, kwargs: str, method: str, path: Path, sha256: str) -> Baseline | PolicyFile:
    enter = partial(_enter, kind, id, kwargs, method, sha256)
    try:
        about = enter().about
    except GuestError as error:
        raise ValueError(f"{path} cannot be played: {error}") from None
    if about.get("privileged"):
        raise ValueError(f"{path} is privileged: it asks for the truth, which a process of its own has not")
    if path.suffix == ".py":
        about = about | {"name": path.stem}  # a guest may call itself anything
    sound = {"name": isinstance(about.get("name"), str) and NAME.fullmatch(about["name"]),
             "title": isinstance(about.get("title"), str) and about["title"],
             "parameters": isinstance(about.get("parameters"), dict), "role": about.get("role") in ROLES,
             "boards": kind == "policy" or all(board in BOARDS for board in about.get("boards") or [None])}
    if wrong := [name for name, is_sound in sound.items() if not is_sound]:
        raise ValueError(f"{path} says nonsense of its {', '.join(wrong)}")
    if kind == "policy" and _own_names(id).get(about["name"], sha256) != sha256:
        raise ValueError(f"{path} has the name of one of ours, {about['name']}, under which results are kept")
    name, title, parameters, role = (about[key] for key in ("name", "title", "parameters", "role"))
    # in the one that its guest knows
    there = _Elsewhere(enter, lambda world: bool(about.get("suits")))
    if kind == "estimator":
        return Baseline(name, title, path, sha256, tuple(about["boards"]), parameters, there, role)
    return PolicyFile(name, title, path, sha256, False, parameters, there, role)


def _own_names(id: str) -> dict[str, str]:
    """Under which the results of our own policies and agents are kept, and the sha256 of their
    files."""
    policies = {name: find_policy(name) for name in own_policies()}
    agents = {f"{path.parents[1].name}_{path.parent.name}": path for path in map(Path, own_agents(id))}
    return {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in (policies | agents).items()}


def _enter(kind: str, id: str, kwargs: str, method: str, sha256: str) -> Guest:
    """The present guest if it plays this and can be asked; else a fresh one takes its place."""
    key = (kind, id, kwargs, method, sha256)
    if not _present or _present[0][0] != key or not _present[0][1].alive:
        close()
        atexit.register(close)
        _present.append((key, Guest(kind, id, json.loads(kwargs), method)))
    guest = _present[0][1]
    if guest.sha256 not in ("", sha256):
        close()
        raise GuestError(f"ValueError: {method} was changed while it was being played")
    return guest
