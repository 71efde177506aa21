"""A cache folder for each test, and one tiny episode."""

import pytest
from eitbench.data.cache import CACHE_VARIABLE
from eitbench.data.episodes import simulate

from recorded import forget
from tiny_worlds import TINY


@pytest.fixture
def place(tmp_path, monkeypatch):
    """The cache folder of a test, in a process that has read nothing yet."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    forget()
    yield tmp_path / "cache"
    forget()


@pytest.fixture(scope="session")
def episode():
    """Seed 7 of the tiny world, simulated without a cache."""
    return simulate(TINY, 7, cache=False)
