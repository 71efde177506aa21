"""Recordings of one tiny episode, in a cache folder of a test's own."""

from types import SimpleNamespace

import pytest
from eitbench.data import recordings
from eitbench.data.episodes import simulate
from eitbench.data.store import CACHE_VARIABLE

from recorded import bits, forget
from tiny_worlds import TINY


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A cache folder of its own for each test, as a process finds it that has seen nothing yet."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    forget()
    yield tmp_path / "cache"
    forget()


@pytest.fixture(scope="module")
def episode():
    """Seed 7, simulated without a cache."""
    return simulate(TINY, 7, cache=False)


@pytest.fixture
def counted(monkeypatch, episode):
    """`simulate` replaced by one that returns seed 7 at once and counts its calls."""
    calls = []
    monkeypatch.setattr(recordings, "simulate", lambda *arguments: calls.append(arguments)
                        or episode)
    return SimpleNamespace(bits=bits(recordings.make_recording(TINY, 7, episode)), calls=calls)
