"""The cache folder: arrays kept under a name, whole or not at all, believed by their checksum."""

from __future__ import annotations

import hashlib
import io
import json
import os
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from eitbench._code import code_digest, file_of, package_files
from eitbench._files import PACKAGE, write_atomically
from eitbench.worlds.parts import LATER
from eitbench.worlds.world import World

CACHE_VARIABLE = "EITBENCH_CACHE"
CODE = ("numerics/*.py", "physics/*.py", "worlds/*.py", "data/*.py")
"""What episodes are computed with: other code keeps its episodes elsewhere."""


def cache_folder() -> Path:
    """$EITBENCH_CACHE, else $XDG_CACHE_HOME/eitbench, else ~/.cache/eitbench."""
    if os.environ.get(CACHE_VARIABLE):
        return Path(os.environ[CACHE_VARIABLE])
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "eitbench"


def folder(world: World) -> Path:
    """Where the episodes of a world, as this version simulates them, are kept.

    Worlds that differ in the instrument only, but for its contacts, or in what is believed, share
    their episodes.
    """
    return cache_folder() / f"{world.name}-{_digest(world.fluid)}"


def identity(world: World) -> dict[str, Any]:
    """All that an episode's numbers depend on but the seed: the world's parts, the code that
    simulates, and the libraries beneath it."""
    return {"world": described(world.fluid), "code": _code(), "parts": _parts(kinds(world.fluid)),
            **{name: version(name) for name in ("numba", "scikit-fem")},
            "numpy": np.__version__, "scipy": scipy.__version__}


@lru_cache(maxsize=64)
def world_digest(world: World) -> str:
    """Of all that a score depends on but seed, question and method: what `identity` names, and the
    instrument, the schedule and what is believed beforehand."""
    said = [identity(world), described(world), _parts(kinds(world))]
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def described(part: Any) -> Any:
    """A dataclass as JSON, with the names of its classes; without those of its numbers that came
    later (`LATER`) and are at their default."""
    if is_dataclass(part):
        kind = type(part)
        return {"kind": f"{kind.__module__}.{kind.__qualname__}"} | {
            each.name: described(value) for each in fields(part)
            if not ((value := getattr(part, each.name)) == each.default
                    and each.metadata == LATER)}
    return list(part) if isinstance(part, tuple) else part


def kinds(part: Any) -> list[type]:
    """The classes of a world's parts, and those they descend from, each once."""
    inner = [kind for each in fields(part) if is_dataclass(value := getattr(part, each.name))
             for kind in kinds(value)]
    return list(dict.fromkeys([*type(part).__mro__, *inner]))


def load(path: Path, names: Sequence[str], label: str = "") -> dict[str, np.ndarray] | None:
    """The arrays of these names that were saved at ``path`` under this ``label``; None if they are
    not there, damaged, or another's: of another label, or from a folder of another name."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in names}
            is_sound = int(stored["checksum"]) == _checksum(path, arrays, label)
            return arrays if is_sound else None
    # a damaged archive may raise anything: zlib.error, NotImplementedError, RuntimeError, …
    except Exception:
        return None


def npy(array: np.ndarray) -> bytes:
    """An array as numpy's own file."""
    content = io.BytesIO()
    np.save(content, array)
    return content.getvalue()


@contextmanager
def cache_in(folder: Path) -> Iterator[None]:
    """Within, this is the cache folder, of processes that are started too."""
    before = os.environ.get(CACHE_VARIABLE)
    os.environ[CACHE_VARIABLE] = str(folder)
    try:
        yield
    finally:
        del os.environ[CACHE_VARIABLE]
        if before is not None:
            os.environ[CACHE_VARIABLE] = before


def save(path: Path, arrays: Mapping[str, np.ndarray], label: str = "", *,
         small: bool = False) -> None:
    """Keep arrays at ``path``, ``small``: compressed. ``label`` says whose they are."""
    content = io.BytesIO()
    write = np.savez_compressed if small else np.savez
    write(content, checksum=_checksum(path, arrays, label), **arrays)  # type: ignore[arg-type]
    write_atomically(path, content.getvalue())


def kept(path: Path, names: Sequence[str], make: Callable[[], Mapping[str, np.ndarray]],
         label: str = "", *, small: bool = False) -> Mapping[str, np.ndarray]:
    """The arrays at ``path``; made and kept, if they are not there. See `load` and `save`."""
    found = load(path, names, label)
    if found is not None:
        return found
    made = make()
    try:
        save(path, made, label, small=small)
    except OSError as error:
        warn_not_kept(path.parent, error)
    return made


def warn_not_kept(place: Path, error: OSError) -> None:
    """Say once that the cache cannot be written."""
    warnings.warn(f"episodes cannot be kept in {place} ({error}) and will be simulated again; "
                  f"${CACHE_VARIABLE} names another folder", stacklevel=3)


@lru_cache(maxsize=64)
def _digest(world: World) -> str:
    return hashlib.sha256(json.dumps(identity(world), sort_keys=True).encode()).hexdigest()[:16]


@lru_cache(maxsize=1)
def _code() -> str:
    """Of the code that simulates; read once a process."""
    return code_digest(package_files(*CODE))


def _parts(classes: Sequence[type]) -> str:
    """Of the files, beside this package's, in which these classes are written."""
    files = [file for kind in classes if kind.__module__ not in ("builtins", "typing")
             and (file := file_of(kind)) and PACKAGE not in file.parents]
    return code_digest(dict.fromkeys(files))


def _checksum(path: Path, arrays: Mapping[str, np.ndarray], label: str) -> int:
    """Of the arrays' bytes and of whose they are: a file under another's name is not believed."""
    content = b"".join(np.ascontiguousarray(array).tobytes() for array in arrays.values())
    return zlib.crc32(content, zlib.crc32(f"{path.parent.name} {label}".encode()))
