"""Recordings on disk: damage is never believed, and what is sound is read where it lies."""

import os

import eitbench  # noqa: F401 (registers)
import gymnasium as gym
import numpy as np
import pytest
from eitbench.data import recordings, store
from eitbench.data.recordings import (
    SPARSE,
    cycle_voltages,
    is_recorded,
    outline,
    recording,
    recording_path,
    sparse_of,
)
from eitbench.data.store import CACHE_VARIABLE, folder
from eitbench.worlds.pipe2d import PIPE_2D

from recorded import HEADER, bits, forget, outline_bits
from tiny_worlds import CHANGES, TINY

pytestmark = pytest.mark.usefixtures("cache")


def test_stored_recording_is_mapped_and_read_only(counted):
    """Once stored it is read where it lies, the first time and later, and cannot be changed."""
    recording(TINY, 7)
    forget()
    for entries in (recording(TINY, 7), recording(TINY, 7)):
        assert isinstance(entries.base, np.memmap) and entries.base.mode == "r"
        assert bits(entries) == counted.bits
        for name in entries.dtype.names:
            with pytest.raises(ValueError, match="read-only"):
                entries[name][0] = 0.0
    assert len(counted.calls) == 1


def test_is_recorded_tells_what_is_there(counted):
    """False before, true after, false for another seed, world or a damaged file."""
    assert not is_recorded(TINY, 7)
    recording(TINY, 7)
    assert is_recorded(TINY, 7) and not is_recorded(TINY, 8) and not is_recorded(PIPE_2D, 7)
    forget()
    path = recording_path(TINY, 7)
    path.write_bytes(path.read_bytes()[:-1])
    assert not is_recorded(TINY, 7) and len(counted.calls) == 1


DAMAGE = [
    pytest.param(lambda data: b"", id="empty"),
    pytest.param(lambda data: data[:100], id="part of the header"),
    pytest.param(lambda data: data[:len(data) // 2], id="half"),
    pytest.param(lambda data: data[:-1], id="one byte short"),
    pytest.param(lambda data: b"\0" * len(data), id="zeros"),
    pytest.param(lambda data: data[:len(data) // 2].ljust(len(data), b"\0"), id="half zeros"),
    pytest.param(lambda data: data[:-1] + bytes([data[-1] ^ 1]), id="last bit"),
    pytest.param(lambda data: b"not a recording", id="text"),
]


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_recording_is_rebuilt(damage, counted):
    """What a full disk or a lost power supply leaves is noticed by the next process and replaced
    for all later ones."""
    recording(TINY, 7)
    path = recording_path(TINY, 7)
    path.write_bytes(damage(path.read_bytes()))
    for _ in range(3):
        forget()
        assert bits(recording(TINY, 7)) == counted.bits
    assert len(counted.calls) == 2 and list(path.parent.glob(f"*{path.name}*")) == [path]


def test_any_flipped_byte_of_a_step_is_noticed(counted):
    """Wherever a byte is inverted behind the header, in numbers or checksums, the recording is made
    again."""
    recording(TINY, 7)
    path = recording_path(TINY, 7)
    data = path.read_bytes()
    assert len(data) == HEADER + 5 * counted.bits[0].itemsize
    places = [*range(HEADER, len(data), 211), *range(len(data) - 24, len(data))]
    for place in places:
        path.write_bytes(data[:place] + bytes([data[place] ^ 0xFF]) + data[place + 1:])
        forget()
        assert bits(recording(TINY, 7)) == counted.bits, f"byte {place} of {len(data)}"
    assert len(counted.calls) == 1 + len(places)


def test_file_changed_under_a_running_process_is_read_again(counted):
    """A process that knows a file as sound looks again once its size or its time of change is
    another."""
    recording(TINY, 7)
    assert recording(TINY, 7) is not None
    path = recording_path(TINY, 7)
    data, before = path.read_bytes(), path.stat().st_mtime_ns
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    os.utime(path, ns=(before + 10**6, before + 10**6))
    assert bits(recording(TINY, 7)) == counted.bits and len(counted.calls) == 2
    recording(TINY, 7)
    before = path.stat().st_mtime_ns
    path.write_bytes(data[:-1])
    os.utime(path, ns=(before, before))
    assert bits(recording(TINY, 7)) == counted.bits and len(counted.calls) == 3


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_outline_is_rebuilt(damage):
    """The outline that comes back, and the file it leaves, are as before."""
    good = outline_bits(outline(TINY))
    path = folder(TINY) / "outline.npz"
    path.write_bytes(damage(path.read_bytes()))
    forget()
    assert outline_bits(outline(TINY)) == good
    assert outline_bits(as_outline(store.load(path, OUTLINE))) == good


def test_any_flipped_byte_of_an_outline_is_harmless():
    """Wherever a byte is inverted, the right outline comes back: the file is read as it was meant,
    or not at all."""
    good = outline_bits(outline(TINY))
    path = folder(TINY) / "outline.npz"
    data = path.read_bytes()
    ends = [*range(0, 160, 16), *range(len(data) - 400, len(data), 16)]
    refused = 0
    for place in [*ends, *np.random.default_rng(3).integers(0, len(data), 20)]:
        path.write_bytes(data[:place] + bytes([data[place] ^ 0xFF]) + data[place + 1:])
        stored = store.load(path, OUTLINE)
        refused += stored is None
        assert stored is None or outline_bits(as_outline(stored)) == good, f"byte {place}"
    assert refused > 20


OUTLINE = (*SPARSE, "largest")
"""What an outline's file holds."""


def as_outline(stored):
    """The outline that these arrays hold."""
    return recordings.Outline(sparse_of(stored), float(stored["largest"]))


def test_unwritable_cache_warns_and_still_plays(monkeypatch, cache, counted):
    """Nothing can be kept: each is said in words, and the numbers are those of any other
    machine."""
    def fail(*_):
        raise OSError("no space left on device")

    for module in (recordings, store):
        monkeypatch.setattr(module, "write_atomically", fail)
    said = f"cannot be kept in .*no space left on device.*{CACHE_VARIABLE}"
    with pytest.warns(UserWarning, match=said):
        stage = outline(TINY)
    for _ in range(2):
        with pytest.warns(UserWarning, match="will be simulated again"):
            entries = recording(TINY, 7)
        assert bits(entries) == counted.bits
    assert not cache.exists() and len(counted.calls) == 2
    env = gym.make("eitbench/Pipe2D-v0", world=CHANGES).unwrapped
    with pytest.warns(UserWarning, match="cannot be kept"):
        observation, _ = env.reset(seed=7)
    np.testing.assert_array_equal(observation["voltages"], cycle_voltages(TINY, 7, entries)[0])
    rewards = [env.step(np.full(1701, TINY.background))[1] for _ in range(5)]
    np.testing.assert_allclose(rewards[2:], -(entries["deviation"] / entries["square"])[2:],
                               rtol=1e-12)
    assert rewards[:2] == [0.0, 0.0] and stage.mass.shape == (1701, 1701)


@pytest.mark.parametrize("mask", [0x01, 0x02, 0x08, 0xFF])
def test_any_flipped_byte_of_the_header_is_harmless(mask, counted):
    """Wherever the header is damaged, the right recording comes back."""
    recording(TINY, 7)
    path = recording_path(TINY, 7)
    data = path.read_bytes()
    for place in range(HEADER):
        path.write_bytes(data[:place] + bytes([data[place] ^ mask]) + data[place + 1:])
        forget()
        assert bits(recording(TINY, 7)) == counted.bits, place


def test_recording_is_read_only_from_the_first_call(counted):
    """Also the one that was just simulated."""
    with pytest.raises(ValueError, match="read-only"):
        recording(TINY, 7)["noise"][0] = 0.0


def test_recording_under_another_name_is_not_believed(counted):
    """Seed 7's file is sound, but not as seed 8's."""
    recording(TINY, 7)
    recording_path(TINY, 7).rename(recording_path(TINY, 8))
    assert not is_recorded(TINY, 8)


def test_file_that_cannot_be_opened_is_not_a_missing_one(monkeypatch, counted):
    """With too many files open, the error says so; nothing is simulated in its stead."""
    recording(TINY, 7)

    def refuse(*_):
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(recordings.np, "memmap", refuse)
    with pytest.raises(OSError, match="Too many open files"):
        recording(TINY, 7)
    assert len(counted.calls) == 1
