"""The store: what is kept comes back bit for bit, or not at all; damage and strangers are never
believed."""

import importlib
import itertools
import os
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import make_dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from eitbench._files import write_atomically
from eitbench.data import store
from eitbench.data.store import CACHE_VARIABLE, cache_folder, folder, kept, load, save
from eitbench.worlds.flows import LaminarFlow
from eitbench.worlds.instrument import Instrument
from eitbench.worlds.parts import Prior

from tiny_worlds import TINY

NAMES = ("small", "large", "empty")
RNG = np.random.default_rng(3)
ARRAYS = {"small": RNG.normal(size=(3, 2)), "large": RNG.normal(size=400).astype(np.float32),
          "empty": np.empty((5, 0))}


@pytest.fixture
def path(tmp_path):
    """A file in a folder that is not there yet."""
    return tmp_path / "World-1234" / "7.truth.npz"


def bits(arrays):
    """All that makes two sets of arrays the same."""
    return {name: (arrays[name].dtype.str, arrays[name].shape, arrays[name].tobytes())
            for name in NAMES}


def files(place):
    """Every file below a folder, hidden ones too."""
    return sorted(each for each in Path(place).rglob("*") if each.is_file())


def counting():
    """A maker of the arrays, and the list of its calls."""
    calls = []
    return (lambda: calls.append(1) or ARRAYS), calls


# -- whole or not at all ---------------------------------------------------------------------------


@pytest.mark.parametrize("small", [False, True])
def test_what_is_saved_comes_back(small, path):
    """Values, types and shapes; made once, and kept in one file."""
    make, calls = counting()
    for _ in range(3):
        assert bits(kept(path, NAMES, make, "7", small=small)) == bits(ARRAYS)
    assert len(calls) == 1 and files(path.parent) == [path]
    assert bits(load(path, NAMES, "7")) == bits(ARRAYS)


def test_what_is_not_there_is_none(path):
    """Neither a file nor its folder is made by looking; a folder in its place is no file."""
    assert load(path, NAMES) is None and not path.parent.exists()
    path.mkdir(parents=True)
    assert load(path, NAMES) is None


def assert_made_again(path):
    """What lies there is not believed; it is made once, and good for the next call."""
    assert load(path, NAMES, "7") is None
    make, calls = counting()
    for _ in range(2):
        assert bits(kept(path, NAMES, make, "7")) == bits(ARRAYS)
    assert len(calls) == 1 and files(path.parent) == [path]


@pytest.mark.parametrize("damage", [
    pytest.param(lambda data: b"", id="empty"),
    pytest.param(lambda data: data[:100], id="part of the header"),
    pytest.param(lambda data: data[:len(data) // 2], id="half"),
    pytest.param(lambda data: data[:-1], id="one byte short"),
    pytest.param(lambda data: b"\0" * len(data), id="zeros"),
    pytest.param(lambda data: data[:len(data) // 2].ljust(len(data), b"\0"), id="half zeros"),
    pytest.param(lambda data: b"not an archive", id="text"),
])
@pytest.mark.parametrize("small", [False, True])
def test_damaged_file_is_made_again(damage, small, path):
    """What a full disk or a lost power supply leaves is noticed and replaced."""
    save(path, ARRAYS, "7", small=small)
    path.write_bytes(damage(path.read_bytes()))
    assert_made_again(path)


@pytest.mark.parametrize("small", [False, True])
def test_any_flipped_byte_is_harmless(small, path):
    """Wherever a byte is inverted: the file is read as it was meant, or not at all."""
    save(path, ARRAYS, "7", small=small)
    data = path.read_bytes()
    refused = 0
    for place in range(0, len(data), 4):
        path.write_bytes(data[:place] + bytes([data[place] ^ 0xFF]) + data[place + 1:])
        found = load(path, NAMES, "7")
        refused += found is None
        assert found is None or bits(found) == bits(ARRAYS), f"byte {place} of {len(data)}"
    assert refused > len(data) // 8                     # most bytes carry meaning


def test_numbers_that_do_not_fit_the_checksum_are_made_again(path):
    """A whole archive in which one number was changed is noticed."""
    save(path, ARRAYS, "7")
    with np.load(path) as stored:
        content = dict(stored)
    content["small"][0, 0] *= 1.0 + 1e-12
    np.savez(path, **content)
    assert_made_again(path)


def test_missing_array_is_noticed(path):
    """An archive that is sound, but of other arrays."""
    save(path, {"small": ARRAYS["small"]}, "7")
    assert_made_again(path)


@pytest.mark.parametrize("stranger", ["label", "folder"])
def test_file_of_something_else_is_made_again(stranger, path):
    """A sound file under the right name, but of another label, or from another world's folder."""
    other = path.parent.with_name("World-5678") / path.name if stranger == "folder" else path
    save(other, ARRAYS, "8" if stranger == "label" else "7")
    path.parent.mkdir(exist_ok=True)
    other.rename(path)
    assert_made_again(path)


def test_folder_may_be_moved(path, tmp_path):
    """A cache that is copied elsewhere is as good there."""
    save(path, ARRAYS, "7")
    (tmp_path / "elsewhere").mkdir()
    moved = path.parent.rename(tmp_path / "elsewhere" / path.parent.name)
    assert bits(load(moved / path.name, NAMES, "7")) == bits(ARRAYS)


def test_threads_that_store_and_read_at_once(path):
    """Eight threads, one file: whoever reads sees all of it, and one file stays."""
    together = threading.Barrier(8)

    def use(_):
        together.wait()
        return [bits(kept(path, NAMES, lambda: ARRAYS)) for _ in range(10)]

    with ThreadPoolExecutor(8) as pool:
        seen = list(itertools.chain.from_iterable(pool.map(use, range(8))))
    assert len(seen) == 80 and all(each == bits(ARRAYS) for each in seen)
    assert files(path.parent) == [path]


def test_unwritable_folder_warns_and_still_gives_the_numbers(path, monkeypatch):
    """Said in words, with the variable that names another folder; each call makes them anew."""
    def fail(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr(store, "write_atomically", fail)
    make, calls = counting()
    said = f"cannot be kept in .*no space left on device.* simulated again.*{CACHE_VARIABLE}"
    for _ in range(2):
        with pytest.warns(UserWarning, match=said):
            assert bits(kept(path, NAMES, make)) == bits(ARRAYS)
    assert len(calls) == 2 and not path.parent.exists()


def test_folder_that_is_a_file_warns(tmp_path):
    """Not only a full disk: any place that cannot be written to."""
    (tmp_path / "taken").write_text("")
    with pytest.warns(UserWarning, match="cannot be kept"):
        kept(tmp_path / "taken" / "7.npz", NAMES, lambda: ARRAYS)


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_failed_write_leaves_no_trace(error, tmp_path, monkeypatch):
    """If writing fails or is interrupted, the old file stays as it was, and nothing beside it."""
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


def test_written_files_are_as_readable_as_any_other(tmp_path):
    """A page to publish or a cache to share has the permissions that the user's umask gives."""
    (tmp_path / "usual").write_bytes(b"")
    write_atomically(tmp_path / "ours", b"")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "usual").stat().st_mode


# -- where it lies ---------------------------------------------------------------------------------


def test_cache_folder(monkeypatch, tmp_path):
    """$EITBENCH_CACHE before $XDG_CACHE_HOME before ~/.cache."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    assert cache_folder() == tmp_path / "cache"
    monkeypatch.setenv(CACHE_VARIABLE, "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_folder() == tmp_path / "xdg" / "eitbench"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_folder() == tmp_path / ".cache" / "eitbench"


def test_worlds_of_other_numbers_lie_elsewhere():
    """Each part's numbers count, and the name; the folder begins with it."""
    others = [TINY, *(TINY.changed(change) for change in (
        {"vessel": {"contact_impedance": 1e-3}}, {"flow": {"diffusivity": 1e-3}},
        {"target": {"arrivals": {"interval": 0.021}}}, {"schedule": {"pattern": {"frame": 3}}},
        {"instrument": {"current": 0.2}}, {"prior": {"expected_concentration": 24.0}},
        {"region": [0.28, 0.40]})), replace(TINY, name="Other")]
    assert len({folder(each) for each in others}) == len(others)
    assert folder(TINY).name.startswith("Pipe2D-")


def test_worlds_that_differ_in_what_is_read_share_their_episodes():
    """An instrument's noise and faults, a budget, and what is believed do not move the fluid."""
    for change in ({"instrument": {"noise_relative": 0.05, "dead": [1, 1]}},
                   {"prior": {"inflow_std": 0.5}}, {"schedule": {"budget": 2}}):
        other = TINY.changed(change)
        assert other != TINY and folder(other) == folder(TINY)
    assert TINY.fluid.instrument == Instrument(current=TINY.instrument.current)
    assert TINY.fluid.prior == Prior(TINY.expected_concentration)


def test_other_code_keeps_its_episodes_elsewhere(monkeypatch):
    """Also other libraries beneath it."""
    before = store.identity(TINY)
    with monkeypatch.context() as patch:
        patch.setattr(store, "_code", lambda: "older code")
        assert store.identity(TINY) == before | {"code": "older code"}
    assert {"numpy", "scipy", "numba", "scikit-fem"} < before.keys()
    simulating = {file.relative_to(store.PACKAGE).parts[0]
                  for file in store.package_files(*store.CODE)}
    assert simulating == {"numerics", "physics", "worlds", "data"}


@pytest.mark.parametrize(("file", "counts"), [("parent", True), ("child", True),
                                              ("stranger", False)])
def test_files_of_somebodys_part_and_its_ancestors_count(file, counts, tmp_path, monkeypatch):
    """Episodes are others when the file of a part, or of one it descends from, has changed."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "parent.py").write_text(
        "from eitbench.worlds.flows import LaminarFlow\nclass Parent(LaminarFlow): ...\n")
    (tmp_path / "child.py").write_text("from parent import Parent\nclass Child(Parent): ...\n")
    (tmp_path / "stranger.py").write_text("class Stranger: ...\n")
    with monkeypatch.context() as patch:
        patch.setattr(sys, "modules", dict(sys.modules))                # forgets both afterwards
        world = replace(TINY, flow=importlib.import_module("child").Child())
        before = store.identity(world)
        assert before["parts"] != store.identity(TINY)["parts"]
        (tmp_path / f"{file}.py").write_text("# changed\n")
        assert (store.identity(world) != before) == counts


def test_part_that_is_written_nowhere_is_told_by_its_name():
    """A class typed into a session has no file; its name and numbers count."""
    typed = make_dataclass("Typed", [], bases=(LaminarFlow,), frozen=True)
    world = replace(TINY, flow=typed())
    assert store.identity(world)["world"]["flow"]["kind"].endswith("Typed")
    assert folder(world) != folder(replace(TINY, flow=LaminarFlow()))
