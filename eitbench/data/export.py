"""Export of examples to files that do not need this package: one per episode, a README with the
header of a Hugging Face data card, and Croissant metadata."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterable, Mapping
from datetime import date
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from tqdm import tqdm

from eitbench import _check
from eitbench._extras import require_extra
from eitbench._files import PACKAGE, write_atomically
from eitbench.data.cache import config_dict, world_digest
from eitbench.data.dataset import Dataset
from eitbench.data.episode_cache import CSR_ARRAYS
from eitbench.data.presimulation import presimulate
from eitbench.data.seeds import format_seed, is_test, parse_seeds, seed_ranges

SUFFIXES = {"npz": "npz", "hdf5": "h5"}
"""Format -> suffix of its files."""
MIME_TYPES = {".npz": "application/x-npz", ".h5": "application/x-hdf5", ".json": "application/json"}
MESH = "mesh.npz"
INTEGRAL = "(mol/m³)²·m² (m³ in 3D)"
FIELDS = {
    "seed": ("", "", "episode seed"),
    "voltages": ("({steps}, {electrodes})", "V", "noisy measurements, one vector a time step"),
    "currents": ("({steps}, {electrodes})", "A (A/m in 2D)", "injected currents"),
    "truth": ("({steps}, {nodes})", "mol/m³", "concentration at the nodes of `mesh.npz`: "
              "projection p_t of the true concentration c_t on a finer mesh"),
    "unresolved": ("({steps},)", INTEGRAL, "∫(p_t − c_t)²"),
    "square": ("({steps},)", INTEGRAL, "∫c_t²"),
    "velocity": ("({steps}, {velocity})", "m/s",
                 "parameters of the best fit to the true flow; empty if the flow is specified")}
"""Shape, unit and meaning of the arrays of an episode."""
WARNING = "Test episodes are included: use them to report scores, not for training or selection."


def export(examples: Dataset, folder: Path, format: str = "npz", *, n_jobs: int = 1,
           backend: str = "loky") -> int:
    """Write a file for each example, the mesh, a README and Croissant metadata; return the number
    of new examples.

    The same call resumes after an interruption, and other seeds may be added. ``ValueError`` unless
    the folder is new, empty, or of an export of the same world in the same format, "npz" or "hdf5";
    hdf5 needs the extra ``export``, otherwise ``ModuleNotFoundError``. ``n_jobs`` and ``backend``:
    see `eitbench.data.presimulation.presimulate`.
    """
    _check.choice("format", format, SUFFIXES)
    if examples.basis is not None:
        raise ValueError("examples must have their truth on the nodes, got reduced coordinates")
    with require_extra(f"format {format}"):
        if format == "hdf5":
            import h5py  # noqa: F401
    encode = _hdf5 if format == "hdf5" else _npz
    about = _about(examples, format)
    _check_or_write_manifest(folder, json.dumps(about, indent=1) + "\n")
    suffix = SUFFIXES[format]
    paths = {seed: folder / f"{format_seed(seed).replace(':', '-')}.{suffix}"
             for seed in examples.seeds}
    missing = [seed for seed, path in paths.items() if not path.exists()]
    presimulate(examples.world, missing, n_jobs=n_jobs, backend=backend)
    mass = examples.mass
    write_atomically(folder / MESH, _npz(
        {"points": examples.mesh.points, "cells": examples.mesh.cells}
        | {f"mass_{name}": getattr(mass, name) for name in CSR_ARRAYS}))
    for seed in tqdm(missing, desc="writing", unit="episode", disable=None):
        write_atomically(paths[seed], encode(examples.example(seed)._asdict()))
    held = [path.stem.replace("-", ":") for path in folder.glob(f"[!.]*.{suffix}")
            if path.name != MESH]
    tests = any(is_test(parse_seeds(name)[0]) for name in held)
    fields = {name: (shape.format(**about), unit, meaning)
              for name, (shape, unit, meaning) in FIELDS.items()}
    readme = _template("readme.md").format(
        held=seed_ranges(held), warning=WARNING if tests else "", ms=1e3 * about["time_step"],
        numbers=json.dumps(about["world"], indent=1), **about,
        table="\n".join(f"| `{name}` | {' | '.join(texts)} |" for name, texts in fields.items()))
    write_atomically(folder / "README.md", readme.encode())
    files = [folder / "dataset.json", folder / MESH, *folder.glob(f"[!.]*-*.{suffix}")]
    write_atomically(folder / "croissant.json", _croissant(about, files, fields))
    return len(missing)


def _about(examples: Dataset, format: str) -> dict[str, Any]:
    """Return the common properties of all files of a folder, JSON-ready."""
    from eitbench import __version__
    world = examples.world
    flow = world.velocity_model
    return {"environment": examples.env, "format": format, "eitbench": __version__,
            "digest": world_digest(world), "steps": world.n_steps, "warm_up": world.warm_up,
            "time_step": world.time_step, "electrodes": world.vessel.n_electrodes,
            "nodes": examples.mesh.n_nodes, "velocity": 0 if flow is None else flow.n_parameters,
            "world": config_dict(world)}


def _check_or_write_manifest(folder: Path, manifest: str) -> None:
    """Write the manifest into a new folder; ``ValueError`` if the folder holds other files."""
    path = folder / "dataset.json"
    if path.exists():
        if path.read_text(encoding="utf-8") != manifest:
            raise ValueError(f"out must be another folder: {path} has another environment, "
                             "format or version of eitbench")
    elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"out must be a new or empty folder, or one of an export; got {folder}")
    else:
        write_atomically(path, manifest.encode())


def _template(name: str) -> str:
    return (PACKAGE / "data" / f"export_{name}").read_text(encoding="utf-8")


def _croissant(about: dict[str, Any], files: Iterable[Path],
               fields: dict[str, tuple[str, str, str]]) -> bytes:
    """Return Croissant 1.1 metadata with fields on responsible AI (RAI 1.0), dated today."""
    metadata = json.loads(Template(_template("croissant.json")).substitute(
        about, name=about["environment"].replace("/", "-"), date=date.today().isoformat()))
    metadata["distribution"] = [{
        "@type": "cr:FileObject", "@id": path.name, "name": path.name, "contentUrl": path.name,
        "contentSize": f"{path.stat().st_size} B", "encodingFormat": MIME_TYPES[path.suffix],
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest()} for path in sorted(files)]
    (arrays,) = metadata["recordSet"]
    columns = [field["name"] for field in arrays["field"]]
    arrays["data"] = [dict(zip(columns, (name, *texts), strict=True))
                      for name, texts in fields.items()]
    return json.dumps(metadata, indent=1, ensure_ascii=False).encode()


def _npz(arrays: Mapping[str, Any]) -> bytes:
    content = io.BytesIO()
    np.savez(content, **arrays)
    return content.getvalue()


def _hdf5(arrays: Mapping[str, Any]) -> bytes:
    import h5py
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        for name, array in arrays.items():
            file.create_dataset(name, data=array).attrs["units"] = FIELDS[name][1]
    return content.getvalue()
