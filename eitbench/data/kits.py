"""Kits: what playing our own worlds needs and takes long to make, shipped with the package.

A kit belongs to numbers, not to code: what a registered world's numbers make never changes (the
world cards see to that), so its key is the digest of those numbers alone. Tests make every kit
anew and compare; `eitbench kits` writes those that are missing.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from eitbench._files import PACKAGE
from eitbench.data import store
from eitbench.worlds.instrument import Instrument

if TYPE_CHECKING:
    from eitbench.worlds.world import World

KITS = PACKAGE / "data" / "kits"
"""Where they lie: within the package, so that wheels, checkouts and guests find them."""


def outline_numbers(world: World) -> dict[str, Any]:
    """What an `Outline` depends on, whatever flows in the vessel and however it is touched."""
    instrument = Instrument(current=world.instrument.current)
    fluid = store.described(replace(world.fluid, instrument=instrument))
    return {name: fluid[name] for name in ("kind", "vessel", "instrument", "prior")} | {
        "pattern": fluid["schedule"]["pattern"]}


def region_numbers(world: World) -> dict[str, Any]:
    """What the mass matrix of a world's region depends on."""
    fluid = store.described(world.fluid)
    return {name: fluid[name] for name in ("kind", "vessel", "region")}


def model_numbers(world: World) -> dict[str, Any]:
    """What a filter of reduced order depends on: not what is to be seen, nor for how long."""
    sound = store.described(world.sound)
    schedule = sound["schedule"]
    return {name: sound[name] for name in ("kind", "vessel", "flow", "instrument", "prior")} | {
        name: schedule[name] for name in ("pattern", "time_step")}


def beginning_numbers(world: World) -> dict[str, Any]:
    """What the first steps of the first training episode depend on: all that is not the
    instrument's, nor what is believed."""
    return store.described(world.fluid)  # type: ignore[no-any-return]


def kit_path(name: str, numbers: Mapping[str, Any]) -> Path:
    """Where the kit of this name, such as ``outline``, is for these numbers."""
    digest = hashlib.sha256(json.dumps(numbers, sort_keys=True).encode()).hexdigest()
    return KITS / f"{name}-{digest[:16]}.npz"


def shipped_or_kept(name: str, numbers: Mapping[str, Any], path: Callable[[], Path],
                    entries: Sequence[str], make: Callable[[], Mapping[str, np.ndarray]],
                    ) -> Mapping[str, np.ndarray]:
    """The arrays ``entries`` from the kit; else from the cache at ``path()``; else made, and kept
    there. A kit that is missing or damaged is none."""
    shipped = store.load(kit_path(name, numbers), entries, name)
    return store.kept(path(), entries, make) if shipped is None else shipped
