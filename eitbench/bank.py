"""A bank of recordings: many episodes, simulated ahead of training and kept on disk."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from tqdm import tqdm

from eitbench._parallel import in_parallel
from eitbench.episodes import simulate_together
from eitbench.recordings import is_recorded, make_recording, outline, recording_path, recording_type, store_recording

if TYPE_CHECKING:
    from eitbench.scenarios.base import Scenario

TOGETHER = 8
"""Episodes that are simulated side by side."""


def recording_bytes(scenario: Scenario) -> int:
    """Size of one recording on disk, but for its header of a few hundred bytes."""
    n_nodes = outline(scenario).mass.shape[0]
    return scenario.n_steps * recording_type(n_nodes, scenario.currents.shape[1]).itemsize


def fill(scenario: Scenario, seeds: Sequence[int], *, n_jobs: int = 1) -> int:
    """Make the recordings that are missing, in ``n_jobs`` processes, and return their number.

    Each is stored as soon as it is done; after an interruption the same call goes on where it was. Only what an
    environment needs is kept: the truth, five times as large, is simulated anew should anybody ask for it.
    """
    missing = [seed for seed in dict.fromkeys(seeds) if not is_recorded(scenario, seed)]
    together = max(1, min(TOGETHER, -(-len(missing) // n_jobs)))
    groups = [(scenario, missing[k:k + together]) for k in range(0, len(missing), together)]
    with tqdm(total=len(missing), desc="recording", unit="episode", disable=None) as bar:
        for done in in_parallel(_record, groups, n_jobs):
            bar.update(done)
    return len(missing)


def _record(scenario: Scenario, seeds: Sequence[int]) -> int:
    for seed, episode in zip(seeds, simulate_together(scenario, seeds, progress=False), strict=True):
        store_recording(recording_path(scenario, seed), make_recording(scenario, episode))
    return len(seeds)
