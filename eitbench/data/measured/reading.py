"""One door for all readers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from eitbench.data.measured import eidors, ktc, sciospec, table
from eitbench.data.measured.matlab import variables
from eitbench.data.measured.measurements import Measurements

READERS: dict[str, Callable[..., Measurements]] = {
    "hdf5": Measurements.load, "ktc": ktc.read, "eidors": eidors.read, "sciospec": sciospec.read,
    "table": table.read}


def read(path: Path | str, format: str | None = None, **how: Any) -> Measurements:
    """A record from a file or a folder.

    Parameters
    ----------
    path : path
    format : str, optional
        One of `READERS`; by default what the ending and the variables of the file tell.
    how
        Arguments of the reader.
    """
    path = Path(path)
    if not path.exists():
        raise ValueError(f"{path} must be a file or a folder, there is none")
    if format is None:
        format = _format(path)
    if format not in READERS:
        raise ValueError(f"format must be one of {', '.join(READERS)}, got {format!r}")
    return READERS[format](path, **how)


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
