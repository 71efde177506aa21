"""Precomputed files of the package, with which built-in worlds start fast: scoring constants,
reduced models, and the first steps of the first training episode."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from eitbench.bench.tracks import builtin_ids
from eitbench.data.cache import File, ship
from eitbench.data.episode_cache import prefix_file, region_file, scoring_constants_file
from eitbench.estimation.onboard.models import model_file
from eitbench.worlds.bodies import MovingBody
from eitbench.worlds.registry import Entry, entries, entry


def expected_files(ids: Iterable[str]) -> list[File]:
    """Return the files that these ids need, without duplicates."""
    files = {file.key: file for id in ids for file in _files(entry(id))}
    return list(files.values())


def _files(registered: Entry) -> Iterator[File]:
    world = registered.world
    yield scoring_constants_file(world)
    if world.region is not None:
        yield region_file(world)
    # number of steps that the first observation of an environment of this truth needs
    needed = max(1 + (each.track == "injection") * len(each.world.currents)
                 for each in entries().values() if each.world.truth_config == world.truth_config)
    if needed <= world.warm_up:
        yield prefix_file(world, needed)
    if registered.track == "injection" and not isinstance(world.target, MovingBody):
        yield model_file(world)


def write_package_data() -> Iterator[str]:
    """Build the missing files of built-in ids, and yield their names. To renew a file, remove it;
    `tests/data/test_package_data.py` compares existing files with newly built ones."""
    for file in expected_files(builtin_ids()):
        if not file.key.shipped_path.is_file():
            ship(file.key, file.build())
            yield file.key.name
