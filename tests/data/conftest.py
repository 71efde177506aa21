"""A cache folder for each test, the simulated batches, and one tiny episode."""

import pytest
from eitbench.data import presimulation
from eitbench.data.cache import CACHE_VARIABLE
from eitbench.data.episodes import simulate, simulate_batch

from recorded import forget
from short import TINY


@pytest.fixture
def place(tmp_path, monkeypatch):
    """Return the cache folder of a test, with empty caches in memory."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    forget()
    yield tmp_path / "cache"
    forget()


@pytest.fixture
def asked(monkeypatch):
    """Return the seeds of each batch that this process simulates."""
    batches = []

    def counting(world, seeds, *more, **options):
        batches.append(list(seeds))
        return simulate_batch(world, seeds, *more, **options)

    monkeypatch.setattr(presimulation, "simulate_batch", counting)
    return batches


@pytest.fixture(scope="session")
def episode():
    """Return seed 7 of the tiny world, simulated without a cache."""
    return simulate(TINY, 7, cache=False)
