"""One door for all readers."""

from __future__ import annotations

from collections.abc import Callable
from inspect import signature
from pathlib import Path
from typing import Any

from eitbench._extras import needed_by
from eitbench.data.measured import eidors, ktc, sciospec, table
from eitbench.data.measured.matlab import variables
from eitbench.data.measured.measurements import Measurements

READERS: dict[str, Callable[..., Measurements]] = {
    "hdf5": Measurements.load, "ktc": ktc.read, "eidors": eidors.read, "sciospec": sciospec.read,
    "table": table.read}


def read(path: Path | str, format: str | None = None, steps: slice | None = None,
         **how: Any) -> Measurements:
    """A record from a file or a folder.

    Parameters
    ----------
    path : path
    format : str, optional
        One of `READERS`; by default what the ending and the variables of the file tell.
    steps : slice, optional
        Only these readings, as of `Measurements.part`. Of our own files they alone are read.
    how
        Arguments of the reader. Those of a table may also stand in a YAML file beside it of the
        same name: ``electrodes: 16`` and ``current: 0.001``, a line each.

    ``ValueError`` naming the file and what is wrong with it.
    """
    path = Path(path)
    if not path.exists():
        raise ValueError(f"{path} must be a file or a folder, there is none")
    if format is None:
        format = _format(path)
    if format not in READERS:
        raise ValueError(f"format must be one of {', '.join(READERS)}, got {format!r}")
    if format == "table" and not how:
        how = _described(path.with_suffix(".yml"))
    try:
        if steps is None:
            return READERS[format](path, **how)
        if format == "hdf5":
            return Measurements.load(path, steps).part(slice(None))
        return READERS[format](path, **how).part(steps)
    except ValueError as error:
        if str(path) in str(error):
            raise
        raise ValueError(f"{path}: {error}") from None


def _described(path: Path) -> dict[str, Any]:
    """Arguments that stand in a YAML file."""
    if not path.is_file():
        raise ValueError("a table must be described by a YAML file of entries like 'electrodes: "
                         f"16' and 'current: 0.001' (A), there is no {path}")
    with needed_by("a table's description"):
        import yaml
    try:
        said = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ValueError(f"{path} must be a YAML file: {error}") from None
    known = set(signature(table.read).parameters) - {"path"}
    if not isinstance(said, dict) or not set(said) <= known:
        raise ValueError(f"{path} must have entries of {', '.join(sorted(known))}, got {said!r}")
    if missing := {"electrodes", "current"} - set(said):
        raise ValueError(f"{path} must have {', '.join(sorted(missing))}")
    return said


def _format(path: Path) -> str:
    if path.is_dir() or path.suffix == ".eit":
        return "sciospec"
    if path.suffix in (".h5", ".hdf5"):
        return "hdf5"
    if path.suffix == ".mat":
        found = variables(path)
        return "ktc" if {"Inj", "Injref", "CurrentPattern"} & set(found) else "eidors"
    if path.suffix in (".csv", ".tsv", ".txt"):
        return "table"
    raise ValueError(f"{path} must end in .h5, .mat, .eit, .csv, .tsv or .txt, or format must be "
                     f"one of {', '.join(READERS)}")
