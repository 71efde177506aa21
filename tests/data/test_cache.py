"""The cache: arrays come back bit for bit or are built again; damaged or foreign files are rejected."""

import itertools
import os
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, make_dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from eitbench._files import write_atomically
from eitbench.data import cache
from eitbench.data.cache import CACHE_VARIABLE, Key, cache_folder, cached, config_dict, folder, is_cached
from eitbench.worlds import flows
from eitbench.worlds.flows import LaminarFlow

from recorded import forget
from short import TINY

RNG = np.random.default_rng(3)
ARRAYS = {"small": RNG.normal(size=(3, 2)), "large": RNG.normal(size=401).astype(np.float32),
          "columns": np.asfortranarray(RNG.normal(size=(4, 3))), "empty": np.empty((5, 0)), "number": np.array(7),
          "steps": np.array([(1.0, [2, 3]), (4.0, [5, 6])], [("a", "<f8"), ("b", "<i4", (2,))])}
KEY = Key("World-1234", "7")

pytestmark = pytest.mark.usefixtures("place")


def bits(arrays):
    """Return types, shapes, bytes and memory order of arrays."""
    return {name: (array.dtype, array.shape, array.tobytes(), array.flags.f_contiguous)
            for name, array in arrays.items()}


def files(place):
    """Return all files below a folder, including hidden ones."""
    return sorted(each for each in Path(place).rglob("*") if each.is_file())


def counting():
    """Return a function that builds the arrays, and the list of its calls."""
    calls = []
    return (lambda: calls.append(1) or ARRAYS), calls


def test_arrays_come_back_mapped_and_read_only(place):
    """Arrays are built once, and bit-identical if built or loaded."""
    build, calls = counting()
    for _ in range(3):
        found = cached(KEY, build)
        assert bits(found) == bits(ARRAYS)
        with pytest.raises(ValueError, match="read-only"):
            found["small"][0, 0] = 1.0
        forget()
    assert len(calls) == 1 and files(place) == [KEY.path]
    mapped = cached(KEY, build)["large"]
    while mapped.base is not None and not isinstance(mapped, np.memmap):
        mapped = mapped.base
    assert isinstance(mapped, np.memmap)


@pytest.mark.parametrize("damage", [
    pytest.param(lambda data: b"", id="empty"),
    pytest.param(lambda data: data[:len(data) // 2], id="half"),
    pytest.param(lambda data: b"\0" * len(data), id="zeros"),
    pytest.param(lambda data: cache._encode(Key("World-5678", "7"), ARRAYS), id="folder"),
    pytest.param(lambda data: cache._encode(Key("World-1234", "8"), ARRAYS), id="name"),
])
def test_damaged_file_or_file_of_another_key_is_built_again(damage, place):
    """The file is rejected, rebuilt once, and valid for the next call."""
    cached(KEY, lambda: ARRAYS)
    KEY.path.write_bytes(damage(KEY.path.read_bytes()))
    forget()
    assert not is_cached(KEY)
    build, calls = counting()
    for _ in range(2):
        assert bits(cached(KEY, build)) == bits(ARRAYS)
    assert len(calls) == 1 and files(place) == [KEY.path]


def test_any_flipped_byte_is_noticed():
    """Damage of the header, the numbers or the checksum."""
    cached(KEY, lambda: ARRAYS)
    data = KEY.path.read_bytes()
    for position in range(0, len(data), 17):
        KEY.path.write_bytes(data[:position] + bytes([data[position] ^ 0x10]) + data[position + 1:])
        forget()
        assert not is_cached(KEY), f"byte {position} of {len(data)}"


def test_concurrent_writers(place):
    together = threading.Barrier(8)

    def use(_):
        together.wait()
        return [bits(cached(KEY, lambda: ARRAYS)) for _ in range(10)]

    with ThreadPoolExecutor(8) as pool:
        seen = list(itertools.chain.from_iterable(pool.map(use, range(8))))
    assert len(seen) == 80 and all(each == bits(ARRAYS) for each in seen)
    assert files(place) == [KEY.path]


@pytest.mark.parametrize("how", ["full", "file"])
def test_unwritable_cache_warns_and_still_returns_the_arrays(how, place, monkeypatch):
    """The warning names the variable that selects another folder; each call builds again."""
    def fail(*_):
        raise OSError("no space left on device")

    if how == "full":
        monkeypatch.setattr(cache, "write_atomically", fail)
    else:
        place.write_text("")
    build, calls = counting()
    for _ in range(2):
        with pytest.warns(UserWarning, match=f"cannot be kept in .*simulated again.*{CACHE_VARIABLE}"):
            assert bits(cached(KEY, build)) == bits(ARRAYS)
    assert len(calls) == 2


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_failed_write_leaves_no_trace(error, tmp_path, monkeypatch):
    """The old file is unchanged, without other files."""
    path = tmp_path / "folder" / "file"
    write_atomically(path, b"old")

    def fail(*_):
        raise error

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(error):
        write_atomically(path, b"new")
    with pytest.raises(TypeError):
        write_atomically(path, "text")
    assert files(tmp_path) == [path] and path.read_bytes() == b"old"


def test_shipped_arrays_come_first_and_damaged_ones_are_ignored(tmp_path, monkeypatch, place):
    """Shipped arrays are bit-identical and loaded without the cache; a damaged or other file counts as missing."""
    monkeypatch.setattr(cache, "PACKAGE_DATA", tmp_path / "shipped")
    cache.ship(KEY, ARRAYS)
    assert bits(cached(KEY, None)) == bits(ARRAYS) and not place.exists()
    data = KEY.shipped_path.read_bytes()
    cache.ship(Key("World-1234", "8"), ARRAYS)
    foreign = Key("World-1234", "8").shipped_path.read_bytes()
    for damaged in (data[:-9], b"", data[:1], b"\7" + data[1:], foreign):
        KEY.shipped_path.write_bytes(damaged)
        assert cached(KEY, lambda: {"x": np.ones(2)})["x"].tolist() == [1, 1]


def test_cache_folder(monkeypatch, tmp_path):
    """$EITBENCH_CACHE has priority over $XDG_CACHE_HOME, and that over ~/.cache."""
    monkeypatch.setenv(CACHE_VARIABLE, "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_folder() == tmp_path / "xdg" / "eitbench"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_folder() == tmp_path / ".cache" / "eitbench"


def test_keys_depend_on_the_declared_version_and_not_on_the_code(monkeypatch):
    """A moved module keeps them; another version of the simulation or of a third-party part does not."""
    before = folder(TINY)

    def fresh(world=TINY):
        cache.world_digest.cache_clear()
        return folder(world)

    with monkeypatch.context() as patch:
        patch.setattr(LaminarFlow, "__module__", "eitbench.worlds.moved")
        assert fresh() == before
    with monkeypatch.context() as patch:
        patch.setattr(cache, "SIMULATION", cache.SIMULATION + 1)
        assert fresh() != before
    assert fresh() == before

    @dataclass(frozen=True)
    class Mine(LaminarFlow):
        """A third-party part."""

    mine = replace(TINY, flow=Mine())
    first = fresh(mine)
    assert first.name.startswith("Pipe2D-") and fresh(replace(mine, name="Other")).name.startswith("Other-")
    assert first != fresh(replace(TINY, flow=LaminarFlow()))
    assert config_dict(mine)["flow"]["kind"] == f"{__name__}.{Mine.__qualname__}"
    monkeypatch.setattr(Mine, "simulation_version", 2, raising=False)
    assert fresh(mine) != first
    typed = make_dataclass("LaminarFlow", [], bases=(LaminarFlow,), frozen=True)
    assert config_dict(typed())["kind"] != config_dict(flows.LaminarFlow())["kind"]
