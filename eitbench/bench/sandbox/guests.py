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
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from eitbench import _check
from eitbench.bench.methods import (
    PARAMETERS,
    ROLES,
    TITLE,
    Method,
    find_method,
    is_ours,
    load_method,
    own_files,
    own_sha256,
)
from eitbench.bench.names import faults
from eitbench.bench.sandbox.host import Guest, GuestError
from eitbench.bench.tracks import BOARDS

NAME = re.compile(r"[^./\\][^/\\]*")
"""Of a method, as records have it."""
PRIVILEGED = "{} is privileged: it asks for the truth, which a process of its own has not"
_present: list[tuple[tuple[str, ...], Guest]] = []
"""The guest of this process, and whom it plays."""
_walls: list[str] = []


def load(track: str, id: str, kwargs: str, method: str) -> Method:
    """A method of a track, by name or path, for an environment with these arguments (JSON).

    Raises
    ------
    ValueError
        If there is no such file, it cannot be loaded, or it asks for the truth, which a guest has
        not.
    """
    path = find_method(method, track)
    if is_ours(method):  # what it says of itself need not be asked of a guest
        return _ours(track, id, kwargs, method, path)
    return _load(track, id, kwargs, method, path, hashlib.sha256(path.read_bytes()).hexdigest())


def peak_memory() -> int | None:
    """Bytes that the present guest has held at most."""
    return _present[0][1].peak_memory if _present else None


def walls() -> list[str]:
    """What keeps the guests of this process where they are, as the last of them has said."""
    return list(_walls)


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
        guest.begin(random)
        return guest


def _ours(track: str, id: str, kwargs: str, method: str, path: Path) -> Method:
    """One of ours: loaded here, played in a guest."""
    loaded = load_method(method, track)
    if loaded.privileged:
        raise ValueError(PRIVILEGED.format(path))
    enter = partial(_enter, track, id, kwargs, method, loaded.sha256)
    return loaded._replace(make=_Elsewhere(enter, loaded.suits))


@cache
def _load(track: str, id: str, kwargs: str, method: str, path: Path, sha256: str) -> Method:
    enter = partial(_enter, track, id, kwargs, method, sha256)
    try:
        about = enter().about
    except GuestError as error:
        raise ValueError(f"{path} cannot be played: {error}") from None
    if about.get("privileged"):
        raise ValueError(PRIVILEGED.format(path))
    if path.suffix == ".py":
        about = about | {"name": path.stem}  # a guest may call itself anything
    _check_about(path, about, track, id)
    ours = own_files(id).get(about["name"])
    if ours is not None and own_sha256(ours) != sha256:
        raise ValueError(f"{path} has the name of one of ours, {about['name']}, under which "
                         "results are kept")
    # in the one that its guest knows
    there = _Elsewhere(enter, lambda world: bool(about.get("suits")))
    return Method(track, about["name"], about["title"], path, sha256, tuple(about["boards"]),
                  about["parameters"], there, about["role"])


def _check_about(path: Path, about: dict[str, Any], track: str, id: str) -> None:
    """``ValueError``, naming the file, if a guest says of it what no method can be."""
    boards = about.get("boards")
    sound = {
        "name": isinstance(about.get("name"), str) and NAME.fullmatch(about["name"]),
        "title": isinstance(about.get("title"), str) and 0 < len(about["title"]) <= TITLE,
        "role": about.get("role") in ROLES,
        "boards": isinstance(boards, list) and boards and all(
            board in BOARDS[track] for board in boards),
    }
    if wrong := [name for name, is_sound in sound.items() if not is_sound]:
        raise ValueError(f"{path} says nonsense of its {', '.join(wrong)}")
    if wrong := list(faults(about["name"], about["title"], id)):
        raise ValueError(f"{path} cannot have a record: {'; '.join(wrong)}")
    _check.document(f"{path}: parameters", about.get("parameters"), PARAMETERS)


def _enter(track: str, id: str, kwargs: str, method: str, sha256: str) -> Guest:
    """The present guest if it plays this and can be asked; else a fresh one takes its place."""
    key = (track, id, kwargs, method, sha256)
    if not _present or _present[0][0] != key or not _present[0][1].alive:
        close()
        atexit.register(close)
        _present.append((key, Guest(track, id, json.loads(kwargs), method)))
    guest = _present[0][1]
    _walls[:] = guest.walls
    if guest.sha256 not in ("", sha256):
        close()
        raise GuestError(f"ValueError: {method} was changed while it was being played")
    return guest
