"""A cache folder for each test, and one tiny episode."""

import pytest
from eitbench.data.cache import CACHE_VARIABLE
from eitbench.data.episodes import simulate

from recorded import forget
from tiny_worlds import TINY


@pytest.fixture
def place(tmp_path, monkeypatch):
    """Return the cache folder of a test, with empty caches in memory."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    forget()
    yield tmp_path / "cache"
    forget()


@pytest.fixture(scope="session")
def episode():
    """Return seed 7 of the tiny world, simulated without a cache."""
    return simulate(TINY, 7, cache=False)
