"""Simulate many episodes ahead of training and keep their recordings in the cache."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from eitbench import _check
from eitbench.data import cache
from eitbench.data.episodes import simulate_together
from eitbench.data.parallel import in_parallel
from eitbench.data.recordings import is_recorded, make_recording, recording_key, recording_type
from eitbench.data.regions import outline

if TYPE_CHECKING:
    from eitbench.worlds.world import World

TOGETHER = 8
"""Episodes that are simulated together."""


def recording_bytes(world: World) -> int:
    """Return the size of a recording on disk without its header."""
    return world.n_steps * recording_type(world, outline(world).mass.shape[0]).itemsize


def missing_seeds(world: World, seeds: Sequence[int]) -> list[int]:
    """Return those of ``seeds`` without a sound recording."""
    checked = dict.fromkeys(_check.integer("seeds", seed, low=0) for seed in seeds)
    return [seed for seed in checked if not is_recorded(world, seed)]


def fill(world: World, seeds: Sequence[int], *, n_jobs: int = 1, backend: str = "loky") -> int:
    """Simulate the missing recordings in ``n_jobs`` processes and return their number.

    ``backend`` is one of `eitbench.data.parallel.BACKENDS`; those of a cluster need the cache
    folder on all machines. Each recording is stored as soon as it is done, so that the same call
    resumes after an interruption. The truth itself, five times as large, is not kept.
    """
    n_jobs = _check.integer("n_jobs", n_jobs, low=1)
    missing = missing_seeds(world, seeds)
    size = max(1, min(TOGETHER, -(-len(missing) // n_jobs)))
    # The folder is determined here: a worker may have started under another environment.
    place = cache.cache_folder().absolute()
    groups = [(world, missing[k:k + size], place) for k in range(0, len(missing), size)]
    with tqdm(total=len(missing), desc="recording", unit="episode", disable=None) as bar:
        for done in in_parallel(_record, groups, n_jobs, backend):
            bar.update(done)
    return len(missing)


def fill_here(world: World, seeds: Sequence[int]) -> None:
    """Simulate the missing recordings in this process, and report the progress."""
    missing = missing_seeds(world, seeds)
    for k in range(0, len(missing), TOGETHER):
        _record(world, missing[k:k + TOGETHER], cache.cache_folder(), progress=True)


def _record(world: World, seeds: Sequence[int], place: Path, progress: bool = False) -> int:
    """Simulate and store recordings, and return their number."""
    with cache.cache_in(place):
        for seed, episode in zip(seeds, simulate_together(world, seeds, progress), strict=True):
            entries = make_recording(world, seed, episode)
            cache.store(recording_key(world, seed), {"steps": entries})
    return len(seeds)
