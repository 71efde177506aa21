"""Simulation of episodes in advance, and the sampler of training episodes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from eitbench import _check
from eitbench.data import cache
from eitbench.data.episode_cache import (
    build_cached_episode,
    is_episode_cached,
    scoring_constants,
    step_dtype,
)
from eitbench.data.episodes import simulate_batch
from eitbench.data.parallel import run_parallel
from eitbench.data.seeds import SPLITS
from eitbench.worlds.world import Flow, World

BATCH_SIZE = 8
"""Episodes in a batch of `simulate_batch`."""
MAX_EPISODES = 1000
"""Largest number of training episodes of a growing sampler."""
DEV_EPISODES = 32
"""Number of dev episodes from which unseeded resets draw; the default of training evaluations."""
SINGLE_EPISODE_RESETS = 4
"""First resets, which all begin ``train:0``."""
RESETS_PER_EPISODE = 8
"""Resets per episode at which the number doubles: simulation takes little of the training time."""
LARGE_MESH_NODES = 2500
"""Nodes above which a single episode is simulated instead of a batch."""


def cached_episode_bytes(world: World) -> int:
    """Return the size in bytes of a cached episode on disk without its header."""
    return world.n_steps * step_dtype(world, scoring_constants(world).mass.shape[0]).itemsize


def missing_seeds(world: World, seeds: Sequence[int]) -> list[int]:
    """Return the ``seeds`` without a valid cached episode."""
    checked = dict.fromkeys(_check.integer("seeds", seed, low=0) for seed in seeds)
    return [seed for seed in checked if not is_episode_cached(world, seed)]


def presimulate(world: World, seeds: Sequence[int], *, n_jobs: int = 1, backend: str = "loky",
                show_steps: bool = False) -> int:
    """Simulate the missing episodes in ``n_jobs`` processes and return their number.

    ``backend`` is one of `eitbench.data.parallel.BACKENDS`; a cluster needs the cache folder on all
    machines. Each episode is stored as soon as it is finished, so that the same call resumes after
    an interruption. The concentration fields, five times larger, are not stored. Progress is shown
    by episodes, or with ``show_steps`` by time steps.
    """
    n_jobs = _check.integer("n_jobs", n_jobs, low=1)
    missing = missing_seeds(world, seeds)
    size = max(1, min(BATCH_SIZE, -(-len(missing) // n_jobs)))
    # A worker may have started with another value of $EITBENCH_CACHE.
    folder = cache.cache_folder().absolute()
    batches = [(world, missing[k:k + size], folder, show_steps)
               for k in range(0, len(missing), size)]
    with tqdm(total=len(missing), desc="simulating", unit="episode",
              disable=show_steps or None) as bar:
        for done in run_parallel(_simulate_and_store, batches, n_jobs, backend):
            bar.update(done)
    return len(missing)


def presimulate_if_writable(world: World, seeds: Sequence[int], **options: Any) -> bool:
    """Call `presimulate` and return True; or warn and return False if the cache folder cannot be
    written, so that episodes are simulated when they begin."""
    try:
        presimulate(world, seeds, **options)
    except OSError as error:
        cache.warn_cache_unwritable(cache.folder(world), error)
        return False
    return True


def _simulate_and_store(world: World, seeds: Sequence[int], folder: Path, progress: bool) -> int:
    """Simulate and store episodes, and return their number."""
    with cache.use_cache_dir(folder):
        for seed, episode in zip(seeds, simulate_batch(world, seeds, progress), strict=True):
            steps = build_cached_episode(world, episode)
            cache.store(cache.episode_key(world, seed), {"steps": steps})
    return len(seeds)


class EpisodeSampler:
    """Sampler of the episodes of unseeded resets, from the ``split`` train or dev.

    It draws from the first ``episodes`` episodes, for dev by default from `DEV_EPISODES`. For
    training the number grows by default with the resets since the last seeded one, so that training
    starts before all are simulated: 1 for the first `SINGLE_EPISODE_RESETS` resets, then the
    largest power of two that is at most 1/8 of the number of resets, from 8 up to `MAX_EPISODES`.
    Cached episodes have no influence.
    """

    def __init__(self, episodes: int | None, split: str = "train") -> None:
        if split not in ("train", "dev"):
            raise ValueError(f"split must be train or dev, got {split!r}")
        self._first = SPLITS[split].start
        self.grows = episodes is None and split == "train"
        default = MAX_EPISODES if self.grows else DEV_EPISODES
        self.max_episodes = (default if episodes is None
                             else _check.integer("episodes", episodes, low=1))
        self._can_store = True
        self.reset()

    @property
    def size(self) -> int:
        """Number of episodes that the next reset draws from."""
        if not self.grows:
            return self.max_episodes
        if self._resets < SINGLE_EPISODE_RESETS:
            return 1
        limit = self._resets // RESETS_PER_EPISODE
        return min(self.max_episodes, max(BATCH_SIZE, 1 << limit.bit_length() >> 1))

    def sample_seed(self, random: np.random.Generator) -> int:
        """Draw the seed of the next episode."""
        self._n_candidates = self.size
        self._resets += 1
        return self._first + int(random.integers(self._n_candidates))

    def reset(self) -> None:
        """Restart the growth, after a seeded reset."""
        self._resets = 0
        self._n_candidates = 0

    def ensure_simulated(self, world: World, seed: int) -> None:
        """Simulate all missing candidates if ``seed`` is one, at least a batch if that is cheap."""
        is_candidate = self.grows and seed < self._n_candidates and self._can_store
        if not is_candidate or is_episode_cached(world, seed):
            return
        has_common_flow = type(world.flow).draw is Flow.draw and world.target.is_advected
        is_cheap = has_common_flow and scoring_constants(world).mass.shape[0] < LARGE_MESH_NODES
        wanted = range(max(self._n_candidates, BATCH_SIZE * is_cheap))
        self._can_store = presimulate_if_writable(world, wanted, show_steps=True)
