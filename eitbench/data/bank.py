"""A bank of recordings: many episodes, simulated ahead of training and kept on disk."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from eitbench import _check
from eitbench.data.episodes import simulate_together
from eitbench.data.parallel import in_parallel
from eitbench.data.recordings import (
    is_recorded,
    make_recording,
    outline,
    recording_path,
    recording_type,
    store_recording,
)
from eitbench.data.regions import are_kept, integrals_path, make_integrals, store_integrals

if TYPE_CHECKING:
    from eitbench.worlds.world import World

TOGETHER = 8
"""Episodes that are simulated side by side."""


def recording_bytes(world: World) -> int:
    """Bytes of a recording on disk, with what lies beside it, but for headers of some 100 bytes."""
    n = outline(world).mass.shape[0]
    beside = 0 if world.region is None else 4 * n + 16  # see `Integrals`
    return world.n_steps * (recording_type(world, n).itemsize + beside)


def fill(world: World, seeds: Sequence[int], *, n_jobs: int = 1, backend: str = "loky") -> int:
    """Make the recordings that are missing, in ``n_jobs`` processes, and return their number.

    ``backend`` is one of `eitbench.data.parallel.BACKENDS`, of which those of a cluster need the
    cache folder on all machines.

    Each is stored as soon as it is done; after an interruption the same call goes on where it was.
    Only what an environment needs is kept: the truth, five times as large, is simulated anew should
    anybody ask for it.
    """
    n_jobs = _check.integer("n_jobs", n_jobs, low=1)
    missing = missing_seeds(world, seeds)
    groups = _groups(world, missing, max(1, min(TOGETHER, -(-len(missing) // n_jobs))))
    with tqdm(total=len(missing), desc="recording", unit="episode", disable=None) as bar:
        for done in in_parallel(_record, groups, n_jobs, backend):
            bar.update(done)
    return len(missing)


def fill_here(world: World, seeds: Sequence[int]) -> None:
    """The same in this process, while somebody waits who is told for how long."""
    for group in _groups(world, missing_seeds(world, seeds), TOGETHER):
        _record(*group, progress=True)


def _groups(world: World, seeds: Sequence[int],
            together: int) -> list[tuple[World, list[tuple[int, Path, Path]]]]:
    """Arguments of `_record` for so many seeds at a time."""
    # Paths are found out here: by now a worker may live in another environment than its parent.
    todo = [(seed, recording_path(world, seed), integrals_path(world, seed)) for seed in seeds]
    return [(world, todo[k:k + together]) for k in range(0, len(todo), together)]


def missing_seeds(world: World, seeds: Sequence[int]) -> list[int]:
    """Those of ``seeds`` without a sound recording."""
    checked = dict.fromkeys(_check.integer("seeds", seed, low=0) for seed in seeds)
    return [seed for seed in checked
            if not (is_recorded(world, seed) and are_kept(world, seed))]


def _record(world: World, todo: Sequence[tuple[int, Path, Path]], progress: bool = False) -> int:
    episodes = simulate_together(world, [seed for seed, *_ in todo], progress)
    for (seed, path, beside), episode in zip(todo, episodes, strict=True):
        if world.region is not None:
            store_integrals(beside, seed, make_integrals(world, episode))
        store_recording(path, make_recording(world, seed, episode))
    return len(todo)
