"""Examples as files that others read without this package: one an episode, and a card that says
what they hold."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from eitbench._extras import needed_by
from eitbench._files import write_atomically
from eitbench.data import store
from eitbench.data.bank import fill
from eitbench.data.learning.card import UNITS, card
from eitbench.data.recordings import SPARSE
from eitbench.data.seeds import name_seed

if TYPE_CHECKING:
    from eitbench.data.learning.examples import Dataset

SUFFIXES = {"npz": "npz", "parquet": "parquet", "hdf5": "h5"}
"""Format -> how its files' names end."""
IDENTITY = "dataset.json"
"""What tells whose files these are."""
MESH = "mesh.npz"

Arrays = dict[str, np.ndarray]


def export(examples: Dataset, folder: Path, format: str = "npz", *, n_jobs: int = 1,
           backend: str = "loky") -> int:
    """Write each example into a file of its own, beside the mesh and a card; return how many were
    missing.

    Whatever is simulated for it stays in the cache, and each file is whole or not there: after an
    interruption the same call goes on where it was, and other seeds may be added.

    Parameters
    ----------
    examples : Dataset
    folder : Path
        New, empty, or of an export of the same world in the same format, both true or both of
        the same surrogate.
    format : "npz", "parquet" or "hdf5"
        The last two need the extra ``export``.
    n_jobs, backend
        Of the simulation; see `eitbench.data.bank.fill`.

    Raises
    ------
    ValueError
        If the format is unknown or the folder holds other files.
    ModuleNotFoundError
        If the format's library is not installed.
    """
    if format not in SUFFIXES:
        raise ValueError(f"format must be one of {', '.join(SUFFIXES)}, got {format!r}")
    encode = _encoder(format)
    identity = _identity(examples, format)
    _claim(folder, identity)
    paths = {seed: folder / f"{name_seed(seed).replace(':', '-')}.{SUFFIXES[format]}"
             for seed in examples.seeds}
    missing = [seed for seed, path in paths.items() if not path.exists()]
    if examples.surrogate is None:
        fill(examples.world, missing, n_jobs=n_jobs, backend=backend)
    write_atomically(folder / MESH, _npz(_mesh(examples)))
    write_atomically(folder / "README.md", card(examples, identity, _there(folder, format)))
    for seed in tqdm(missing, desc="writing", unit="episode", disable=None):
        fields = examples.example(seed)._asdict()
        fields["seed"] = np.array(seed)
        write_atomically(paths[seed], encode(fields))
    write_atomically(folder / "README.md", card(examples, identity, _there(folder, format)))
    return len(missing)


def _identity(examples: Dataset, format: str) -> dict[str, Any]:
    """What all files of a folder have in common."""
    from eitbench import __version__
    world = examples.world
    return {"environment": examples.env, "format": format, "eitbench": __version__,
            "digest": store.world_digest(world), "steps": world.n_steps, "warm_up": world.warm_up,
            "time_step": world.time_step, "world": store.described(world)} | (
                {} if examples.surrogate is None else {"surrogate": examples.surrogate.source})


def _claim(folder: Path, identity: dict[str, Any]) -> None:
    """Let the folder hold these files; ``ValueError`` if it holds others."""
    path = folder / IDENTITY
    text = json.dumps(identity, indent=1) + "\n"
    if path.exists():
        if path.read_text(encoding="utf-8") != text:
            raise ValueError(f"out must be another folder: {path} is of another environment, "
                             "format, surrogate or version of eitbench")
    elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"out must be a new or empty folder, or one of an export; got {folder}")
    else:
        write_atomically(path, text.encode())


def _there(folder: Path, format: str) -> list[str]:
    """Names of the files of episodes, without what they end on."""
    files = folder.glob(f"[!.]*.{SUFFIXES[format]}")
    return [path.stem for path in files if path.name != MESH]


def _mesh(examples: Dataset) -> Arrays:
    mass = examples.mass
    return {"points": examples.mesh.points, "cells": examples.mesh.cells} | {
        f"mass_{name}": getattr(mass, name) for name in SPARSE}


def _encoder(format: str) -> Callable[[Arrays], bytes]:
    """Arrays -> the content of a file."""
    with needed_by(f"format {format}"):
        return {"npz": lambda: _npz, "hdf5": _hdf5, "parquet": _parquet}[format]()


def _npz(arrays: Arrays) -> bytes:
    content = io.BytesIO()
    np.savez(content, **arrays)  # type: ignore[arg-type]
    return content.getvalue()


def _hdf5() -> Callable[[Arrays], bytes]:
    import h5py

    def encode(arrays: Arrays) -> bytes:
        content = io.BytesIO()
        with h5py.File(content, "w") as file:
            for name, array in arrays.items():
                file.create_dataset(name, data=array).attrs["units"] = UNITS[name]
        return content.getvalue()

    return encode


def _parquet() -> Callable[[Arrays], bytes]:
    import pyarrow as pa
    from pyarrow import parquet

    def column(array: np.ndarray) -> Any:
        if array.ndim == 1:
            return pa.array(array)
        return pa.FixedSizeListArray.from_arrays(pa.array(array.ravel()), array.shape[1])

    def encode(arrays: Arrays) -> bytes:
        steps = len(arrays["voltages"])
        rows = {"t": np.arange(1, steps + 1)} | {
            name: np.full(steps, array) if name == "seed" else array
            for name, array in arrays.items() if array.size}
        fields = {name: column(array) for name, array in rows.items()}
        schema = pa.schema([pa.field(name, each.type, metadata={"units": UNITS[name]})
                            for name, each in fields.items()])
        content = io.BytesIO()
        table = pa.Table.from_arrays(list(fields.values()), schema=schema)
        parquet.write_table(table, content, use_dictionary=False)
        return content.getvalue()

    return encode
