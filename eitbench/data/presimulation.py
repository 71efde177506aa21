"""Episodes simulated ahead of training: a bank of recordings, and the pool resets draw from."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from eitbench import _check
from eitbench.data import cache
from eitbench.data.episode_cache import (
    build_cached_episode,
    cached_episode_key,
    is_episode_cached,
    scoring_constants,
    step_dtype,
)
from eitbench.data.episodes import simulate_batch
from eitbench.data.parallel import run_parallel
from eitbench.worlds.world import Flow, World

BATCH_SIZE = 8
"""Episodes that are simulated together."""
MAX_EPISODES = 1000
"""Training episodes that a growing pool ends with."""
ALONE = 4
"""First resets, which play ``train:0``."""
RESETS = 8
"""Resets per episode at which a pool doubles: simulation takes little of the training time."""
LARGE = 2500
"""Nodes from which on episodes are simulated only when they are needed."""


def cached_episode_bytes(world: World) -> int:
    """Return the size of a recording on disk without its header."""
    return world.n_steps * step_dtype(world, scoring_constants(world).mass.shape[0]).itemsize


def missing_seeds(world: World, seeds: Sequence[int]) -> list[int]:
    """Return those of ``seeds`` without a sound recording."""
    checked = dict.fromkeys(_check.integer("seeds", seed, low=0) for seed in seeds)
    return [seed for seed in checked if not is_episode_cached(world, seed)]


def presimulate(world: World, seeds: Sequence[int], *, n_jobs: int = 1,
                backend: str = "loky") -> int:
    """Simulate the missing recordings in ``n_jobs`` processes and return their number.

    ``backend`` is one of `eitbench.data.parallel.BACKENDS`; those of a cluster need the cache
    folder on all machines. Each recording is stored as soon as it is done, so that the same call
    resumes after an interruption. The truth itself, five times as large, is not kept.
    """
    n_jobs = _check.integer("n_jobs", n_jobs, low=1)
    missing = missing_seeds(world, seeds)
    size = max(1, min(BATCH_SIZE, -(-len(missing) // n_jobs)))
    # The folder is determined here: a worker may have started under another environment.
    place = cache.cache_folder().absolute()
    groups = [(world, missing[k:k + size], place) for k in range(0, len(missing), size)]
    with tqdm(total=len(missing), desc="recording", unit="episode", disable=None) as bar:
        for done in run_parallel(_record, groups, n_jobs, backend):
            bar.update(done)
    return len(missing)


def presimulate_inline(world: World, seeds: Sequence[int]) -> None:
    """Simulate the missing recordings in this process, and report the progress."""
    missing = missing_seeds(world, seeds)
    for k in range(0, len(missing), BATCH_SIZE):
        _record(world, missing[k:k + BATCH_SIZE], cache.cache_folder(), progress=True)


def _record(world: World, seeds: Sequence[int], place: Path, progress: bool = False) -> int:
    """Simulate and store recordings, and return their number."""
    with cache.use_cache_dir(place):
        for seed, episode in zip(seeds, simulate_batch(world, seeds, progress), strict=True):
            steps = build_cached_episode(world, episode)
            cache.store(cached_episode_key(world, seed), {"steps": steps})
    return len(seeds)


class EpisodeSampler:
    """The training episodes that unseeded resets draw from: few at first, more later, so that
    training starts before a thousand episodes are simulated.

    There are ``episodes`` of them. Without that number there is 1 for the first `ALONE` resets
    since the last seeded one, then 8, and from then on the largest power of two that is at most 1/8
    of the number of resets, up to `MAX_EPISODES`, whatever has been simulated.
    """

    def __init__(self, episodes: int | None) -> None:
        self.grows = episodes is None
        self.max_episodes = (MAX_EPISODES if episodes is None
                             else _check.integer("episodes", episodes, low=1))
        self._can_be_kept = True
        self.reset()

    @property
    def size(self) -> int:
        """Number of episodes that the next reset draws from."""
        if not self.grows:
            return self.max_episodes
        if self._resets < ALONE:
            return 1
        earned = self._resets // RESETS
        return min(self.max_episodes, max(BATCH_SIZE, 1 << earned.bit_length() >> 1))

    def sample_seed(self, random: np.random.Generator) -> int:
        """Return the seed of the next episode."""
        self._drawn_from = self.size
        self._resets += 1
        return int(random.integers(self._drawn_from))

    def reset(self) -> None:
        """Forget all resets, after a seeded one."""
        self._resets = 0
        self._drawn_from = 0

    def ensure_simulated(self, world: World, seed: int) -> None:
        """Simulate all missing episodes of a growing pool, if this is one of them; with the first
        the other seven, where eight take the time of two."""
        wanted = self.grows and seed < self._drawn_from and self._can_be_kept
        if not wanted or is_episode_cached(world, seed):
            return
        shares_its_flow = type(world.flow).draw is Flow.draw and world.target.is_advected
        is_cheap = shares_its_flow and scoring_constants(world).mass.shape[0] < LARGE
        try:
            presimulate_inline(world, range(max(self._drawn_from, BATCH_SIZE * is_cheap)))
        except OSError as error:
            self._can_be_kept = False
            cache.warn_cache_unwritable(cache.folder(world), error)
