"""A cache on disk for arrays that take long to compute: `cached(key, build)`.

A key identifies a configuration and the version of the code that computes from it, not the text of
the code. Raise the version (such as `SIMULATION`) when numbers or names of arrays change.

A file is a .npy of one record with a field for each array, which is memory-mapped, followed by a
checksum of the key and all bytes. Files that the package ships are the same, compressed.
"""

from __future__ import annotations

import hashlib
import io
import json
import lzma
import os
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from eitbench._files import PACKAGE, write_atomically
from eitbench.worlds.fields import ADDED_LATER
from eitbench.worlds.stored_names import STORED_NAMES, is_builtin, stored_names
from eitbench.worlds.world import World

CACHE_VARIABLE = "EITBENCH_CACHE"
PACKAGE_DATA = PACKAGE / "data" / "package_data"
"""Folder of the files that the package ships; `eitbench.bench.package_data` writes them."""
SIMULATION = 3
"""Version of the simulation and of the arrays of a cached episode."""
TRANSPOSED = ".T"
"""End of the name of a field that holds a transposed array. The order in memory is preserved
because rounding in BLAS depends on it."""
WORD = 8
"""Bytes of a checksum; the length of a file is a multiple."""

Arrays = Mapping[str, np.ndarray]


class Key(NamedTuple):
    """The name of cached arrays: a folder and a file in it."""

    folder: str
    name: str

    @property
    def path(self) -> Path:
        """The file in the cache."""
        return cache_folder() / self.folder / f"{self.name}.npy"

    @property
    def shipped_path(self) -> Path:
        """The file in the package."""
        return PACKAGE_DATA / f"{self.name}.xz"


class File(NamedTuple):
    """Key of arrays and the function that builds them: arguments of `cached`."""

    key: Key
    build: Callable[[], Arrays]


def episode_key(world: World, name: int | str) -> Key:
    """Return the key of arrays that depend on `World.truth_config` and on a seed: a cached episode,
    or with the ``name`` SEED.truth its truth."""
    config = world.truth_config
    return Key(f"{config.name}-{world_digest(config)[:16]}", str(name))


def model_key(name: str, configuration: Any, version: int) -> Key:
    """Return the key of arrays that depend on a JSON-ready ``configuration``, not on an episode."""
    return Key("models", f"{name}-{_digest([configuration, version])[:16]}")


def cached(key: Key, build: Callable[[], Arrays], limit: int = 0) -> dict[str, np.ndarray]:
    """Return the arrays of a key, read-only: shipped, memory-mapped from the cache, or built.

    A file that is missing, damaged or of another key is built again and replaced. A cache that
    cannot be written causes a warning. With a ``limit`` the oldest files of this kind, whose names
    agree up to the dash, are deleted if there are more.
    """
    for load in (load_shipped, _load):
        if (found := load(key)) is not None:
            return found
    built = build()
    try:
        store(key, built)
    except OSError as error:
        warn_cache_unwritable(key.path.parent, error)
    if limit:
        with suppress(OSError):  # another process may delete them at the same time
            files = key.path.parent.glob(f"{key.name.partition('-')[0]}-*.npy")
            for old in sorted(files, key=os.path.getmtime)[:-limit]:
                old.unlink()
    return _fields(_record(built))


def store(key: Key, arrays: Arrays) -> None:
    """Write the arrays of a key into the cache, atomically."""
    write_atomically(key.path, _encode(key, arrays))


def is_cached(key: Key) -> bool:
    """Return whether the cache holds a valid file of this key."""
    return _load(key) is not None


def ship(key: Key, arrays: Arrays) -> None:
    """Write the arrays of a key into the package, atomically."""
    content = np.frombuffer(_encode(key, arrays), np.uint8)
    # Bytes of 4-byte or 8-byte numbers may compress better if grouped by significance.
    packed = (bytes([size]) + lzma.compress(content.reshape(-1, size).T.tobytes(), preset=9)
              for size in (1, 4, 8))
    write_atomically(key.shipped_path, min(packed, key=len))


def load_shipped(key: Key) -> dict[str, np.ndarray] | None:
    """Return the arrays that the package ships for a key; None without a valid file."""
    try:
        packed = key.shipped_path.read_bytes()
        regrouped = np.frombuffer(lzma.decompress(packed[1:]), np.uint8)
        content = regrouped.reshape(packed[0], -1).T.tobytes()
    except (FileNotFoundError, lzma.LZMAError, ValueError, IndexError):
        return None
    is_valid = _checksum(key, content[:-WORD]) == content[-WORD:]
    return _fields(np.load(io.BytesIO(content))) if is_valid else None


def warn_cache_unwritable(place: Path, error: OSError) -> None:
    """Warn that the cache cannot be written."""
    warnings.warn(f"episodes cannot be kept in {place} ({error}) and will be simulated again; "
                  f"${CACHE_VARIABLE} names another folder", stacklevel=3)


def cache_folder() -> Path:
    """Return $EITBENCH_CACHE, else $XDG_CACHE_HOME/eitbench, else ~/.cache/eitbench."""
    if os.environ.get(CACHE_VARIABLE):
        return Path(os.environ[CACHE_VARIABLE])
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "eitbench"


@contextmanager
def use_cache_dir(folder: Path) -> Iterator[None]:
    """Use another cache folder within, also in processes that are started there."""
    before = os.environ.get(CACHE_VARIABLE)
    os.environ[CACHE_VARIABLE] = str(folder)
    try:
        yield
    finally:
        del os.environ[CACHE_VARIABLE]
        if before is not None:
            os.environ[CACHE_VARIABLE] = before


def folder(world: World) -> Path:
    """Return the folder of a world's episodes, shared by worlds of one `World.truth_config`."""
    return episode_key(world, "").path.parent


def config_dict(part: Any) -> Any:
    """Return a dataclass as JSON: its class and its fields, by the names in stored keys.

    Built-in classes are named without their module, which may change. Third-party classes are
    named with it, and with their ``simulation_version``, if they declare one. Fields added later
    (`ADDED_LATER`) are omitted at their default.
    """
    if not is_dataclass(part):
        return list(part) if isinstance(part, tuple) else part
    kind = type(part)
    name = kind.__qualname__
    name = STORED_NAMES.get(name, name) if is_builtin(kind) else f"{kind.__module__}.{name}"
    version = getattr(kind, "simulation_version", None)
    names = stored_names(kind)
    values = {names[each.name]: config_dict(value) for each in fields(part)
              if not ((value := getattr(part, each.name)) == each.default
                      and each.metadata == ADDED_LATER)}
    return {"kind": name} | ({} if version is None else {"simulation_version": version}) | values


@lru_cache(maxsize=64)
def world_digest(world: World) -> str:
    """Return a digest of all parameters of a world on which scores depend."""
    return _digest([config_dict(world), SIMULATION])


def _digest(configuration: Any) -> str:
    return hashlib.sha256(json.dumps(configuration, sort_keys=True).encode()).hexdigest()


def array_digest(*arrays: np.ndarray) -> str:
    """Return a digest of the contents of arrays, for a `model_key`."""
    return hashlib.sha256(b"".join(map(_npy, arrays))).hexdigest()


def _npy(array: np.ndarray) -> bytes:
    """Return an array as the content of a .npy file."""
    content = io.BytesIO()
    np.save(content, array)
    return content.getvalue()


def _encode(key: Key, arrays: Arrays) -> bytes:
    """Return the content of a file."""
    content = _npy(_record(arrays))
    content += bytes(-len(content) % WORD)
    return content + _checksum(key, content)


def _checksum(key: Key, content: bytes) -> bytes:
    return zlib.crc32(content, zlib.crc32("/".join(key).encode())).to_bytes(WORD, "little")


def _record(arrays: Arrays) -> np.ndarray:
    """Return one record (1,) with a field for each array, in the array's memory order."""
    held = {}
    for name, array in arrays.items():
        by_columns = array.flags.fnc
        held[name + TRANSPOSED * by_columns] = array.T if by_columns else array
    layout = [(name, array.dtype, array.shape) for name, array in held.items()]
    record = np.zeros(1, np.dtype(layout, align=True))
    for name, array in held.items():
        record[name] = array
    record.setflags(write=False)
    return record


def _fields(record: np.ndarray) -> dict[str, np.ndarray]:
    """Return the arrays of a record."""
    plain = np.asarray(record)
    return {name.removesuffix(TRANSPOSED):
            plain[name][0].T if name.endswith(TRANSPOSED) else plain[name][0]
            for name in plain.dtype.names or ()}


_sound: dict[Path, tuple[int, int]] = {}
"""Size and modification time of the files whose checksum this process has verified."""


def _load(key: Key) -> dict[str, np.ndarray] | None:
    """Return the memory-mapped arrays of a valid file; None without such a file."""
    path = key.path
    try:
        status = os.stat(path)
        stamp = (status.st_size, status.st_mtime_ns)
        if _sound.get(path) != stamp:
            content = path.read_bytes()
            if _checksum(key, content[:-WORD]) != content[-WORD:]:
                return None
            _sound[path] = stamp
        return _fields(np.load(path, mmap_mode="r"))
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        return None
