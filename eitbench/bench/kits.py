"""The kits of our worlds: which there should be, made anew, compared and written."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from eitbench.data import kits, store
from eitbench.data.beginnings import beginning_entries, make_beginning
from eitbench.data.recordings import OUTLINE, SPARSE, half_mass, make_outline
from eitbench.data.regions import region_operators
from eitbench.estimation.onboard import joint_operator, reduced_operator
from eitbench.estimation.onboard.packing import packed, unpacked
from eitbench.estimation.reduced import ReducedModel
from eitbench.estimation.reduced_joint import JointModel
from eitbench.worlds.registry import Entry, entries, entry
from eitbench.worlds.world import World

TOLERANCE = 1e-5
"""Relative difference that is none: models are kept in single precision, and where their space ends
depends on rounding."""
Arrays = Mapping[str, np.ndarray]


class Kit(NamedTuple):
    """A kit that there should be."""

    name: str
    path: Path
    entries: tuple[str, ...]
    make: Callable[[], Arrays]
    """makes its arrays anew"""


def wanted(ids: Iterable[str]) -> list[Kit]:
    """The kits of these ids, each once."""
    found = {kit.path: kit for id in ids for kit in _of(entry(id))}
    return list(found.values())


def _of(registered: Entry) -> Iterator[Kit]:
    world = registered.world
    yield Kit("outline", kits.kit_path("outline", kits.outline_numbers(world)), OUTLINE,
              lambda: make_outline(world))
    if world.region is not None:
        yield Kit("region", kits.kit_path("region", kits.region_numbers(world)), SPARSE,
                  lambda: half_mass(*region_operators(world)))
    alike = [each for each in entries().values() if each.world.fluid == world.fluid]
    if not all(each.home for each in alike):  # a shift is to be tested in, which nobody begins with
        needed = max(map(_needed, alike))
        yield Kit("beginning", kits.kit_path("beginning", kits.beginning_numbers(world)),
                  beginning_entries(world), lambda: make_beginning(world, needed))
    if registered.track == "injection":
        joint = world.velocity_model is not None
        name = "joint" if joint else "reduced"
        model = JointModel if joint else ReducedModel
        yield Kit(name, kits.kit_path(name, kits.model_numbers(world)), model._fields,
                  lambda: _model(world, joint))


def _needed(registered: Entry) -> int:
    """Steps of an episode that the first observation needs."""
    return 1 + (registered.track == "injection") * len(registered.world.currents)


def _model(world: World, joint: bool) -> Arrays:
    make = joint_operator.make_model if joint else reduced_operator.make_model
    with threadpool_limits(1):
        return packed(make(world.sound))


def difference(kit: Kit) -> str:
    """What is other in a kit than in one made anew; empty if nothing is."""
    shipped = store.load(kit.path, kit.entries, kit.name)
    if shipped is None:
        return "missing or damaged"
    return difference_of(shipped, kit.make())


def difference_of(shipped: Arrays, made: Arrays) -> str:
    """The same of two kits' arrays, in parts of the largest entry of each.

    Other processors may choose another basis of the same space: models are compared in one.
    """
    for name, array in made.items():
        there = shipped[name]
        if there.shape != array.shape or there.dtype != array.dtype:
            return f"{name} is {there.dtype} {there.shape}, made {array.dtype} {array.shape}"
    if "basis" in made:
        shipped, made = unpacked(shipped), unpacked(made)
        shipped = _in_basis(shipped, made["basis"])
    for name, array in made.items():
        off = np.abs(shipped[name].astype(float) - array).max() / (np.abs(array).max() or 1.0)
        if not off <= TOLERANCE:
            return f"{name} differs by {off:.2g} of its largest"
    return ""


def _in_basis(model: Arrays, basis: np.ndarray) -> Arrays:
    """The model in the coordinates of another basis (n, r) of the same space."""
    turn, *_ = np.linalg.lstsq(model["basis"], basis)
    back = np.linalg.inv(turn)
    return {**model, "basis": model["basis"] @ turn,
            "transition": back @ model["transition"] @ turn,
            "noise": back @ model["noise"] @ back.T, "initial": back @ model["initial"] @ back.T}


def update(ids: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Compare the kits of these ids with what is made anew, and write those that are missing.

    Yields
    ------
    name, what
        ``what`` is ``new``, ``same`` or what is other; such a kit stays as it is.
    """
    for kit in wanted(ids):
        if not kit.path.is_file():
            store.save(kit.path, kit.make(), kit.name, small=True)
            yield kit.path.name, "new"
        else:
            yield kit.path.name, difference(kit) or "same"
