"""Precomputed files of the package, with which built-in worlds start fast: scoring constants,
reduced models, and the first steps of the first training episode."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from eitbench.bench.tracks import builtin_ids
from eitbench.data.cache import Arrays, File, load_shipped, ship
from eitbench.data.episode_cache import csr_of, prefix_file, region_file, scoring_constants_file
from eitbench.estimation.onboard.models import build_packed_model, reduced_model_key, unpack_model
from eitbench.worlds.bodies import WanderingBody
from eitbench.worlds.registry import Entry, entries, entry

ARRAY_TOLERANCE = 1e-5
"""Accepted difference relative to an array's largest entry: models are in single precision."""


def expected_files(ids: Iterable[str]) -> list[File]:
    """Return the files that these ids need, without duplicates."""
    files = {file.key: file for id in ids for file in _files(entry(id))}
    return list(files.values())


def _files(registered: Entry) -> Iterator[File]:
    world = registered.world
    yield scoring_constants_file(world)
    if world.region is not None:
        yield region_file(world)
    needed = max(_needed_steps(each) for each in entries().values()
                 if each.world.truth_config == world.truth_config)
    if needed <= world.warm_up:
        yield prefix_file(world, needed)
    if registered.track == "injection" and not isinstance(world.target, WanderingBody):
        yield File(reduced_model_key(world), lambda: build_packed_model(world.fault_free))


def _needed_steps(registered: Entry) -> int:
    """Return the number of steps of an episode that the first observation needs."""
    return 1 + (registered.track == "injection") * len(registered.world.currents)


def write_package_data(ids: Iterable[str] = ()) -> Iterator[tuple[str, str]]:
    """Rebuild the shipped files of built-in ids (default: all), in five minutes; write the missing
    files and compare the others, which are not changed.

    Yields
    ------
    name, result
        ``result`` is ``new``, ``same`` or the difference.
    """
    for file in expected_files(ids or builtin_ids()):
        built = file.build()
        if not file.key.shipped_path.is_file():
            ship(file.key, built)
            yield file.key.name, "new"
        else:
            yield file.key.name, difference(load_shipped(file.key), built) or "same"


def difference(shipped: Arrays | None, built: Arrays) -> str:
    """Describe the difference of shipped and rebuilt arrays; empty within `ARRAY_TOLERANCE`.

    The basis of a model's space and the entries of a sparse matrix that are rounded to zero may
    depend on the processor: models are compared in one basis, matrices as dense arrays.
    """
    if shipped is None:
        return "missing or damaged"
    if "indptr" in built:
        shipped, built = _dense(shipped), _dense(built)
    for name, array in built.items():
        there = shipped[name]
        if there.shape != array.shape or there.dtype != array.dtype:
            return f"{name} is {there.dtype} {there.shape}, built {array.dtype} {array.shape}"
    if "basis" in built:
        shipped, built = unpack_model(shipped), unpack_model(built)
        shipped = _in_basis(shipped, built["basis"])
    for name, array in built.items():
        off = np.abs(shipped[name].astype(float) - array).max() / (np.abs(array).max() or 1.0)
        if not off <= ARRAY_TOLERANCE:
            return f"{name} differs by {off:.2g} of its largest entry"
    return ""


def _dense(arrays: Arrays) -> Arrays:
    """Return scoring constants or a region's mass with the matrix as one dense array."""
    return {"mass": csr_of(arrays).toarray()} | {
        name: array for name, array in arrays.items() if name == "largest"}


def _in_basis(model: Arrays, basis: np.ndarray) -> Arrays:
    """Return a model in the coordinates of another basis (n, r) of the same space."""
    turn, *_ = np.linalg.lstsq(model["basis"], basis)
    back = np.linalg.inv(turn)
    return {**model, "basis": model["basis"] @ turn,
            "transition": back @ model["transition"] @ turn,
            "noise": back @ model["noise"] @ back.T, "initial": back @ model["initial"] @ back.T}
