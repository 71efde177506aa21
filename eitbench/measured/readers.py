"""`read`: measurements from a file of any known format; readers of Sciospec files and tables."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable
from datetime import datetime
from inspect import signature
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from eitbench import _check
from eitbench._extras import needed_by
from eitbench.measured.matlab import load_variables, provenance, read_eidors, read_ktc
from eitbench.measured.measurements import Measurements

AMPLITUDE, FREQUENCY, TIME, CHANNELS = 8, 4, 3, "MeasurementChannels:"
"""Header lines of Sciospec's files, from 0: peak current in A, Hz, and the time of the frame."""
TIMESTAMP_FORMAT = "%Y.%m.%d. %H:%M:%S.%f"


def read(path: Path | str, format: str | None = None, steps: slice | None = None,
         **options: Any) -> Measurements:
    """Read measurements from a file or a folder.

    Parameters
    ----------
    path : path
    format : str, optional
        One of `READERS`; default: by the suffix and the variables of the file.
    steps : slice, optional
        Only these readings; other readings of an HDF5 file stay unread.
    options
        Arguments of the reader. A table may have them in a YAML file of the same name:
        ``electrodes: 16`` and ``current: 0.001``, one per line.

    ``ValueError`` names the file and the fault.
    """
    path = Path(path)
    if not path.exists():
        raise ValueError(f"{path} must be a file or a folder, there is none")
    format = format or _detect_format(path)
    if format not in READERS:
        raise ValueError(f"format must be one of {', '.join(READERS)}, got {format!r}")
    if format == "table" and not options:
        options = _table_options(path.with_suffix(".yml"))
    try:
        if format == "hdf5" and steps is not None:
            return Measurements.load(path, steps).select(slice(None))
        found = READERS[format](path, **options)
        return found if steps is None else found.select(steps)
    except ValueError as error:
        if str(path) in str(error):
            raise
        raise ValueError(f"{path}: {error}") from None


def _detect_format(path: Path) -> str:
    if path.is_dir() or path.suffix == ".eit":
        return "sciospec"
    if path.suffix in (".h5", ".hdf5"):
        return "hdf5"
    if path.suffix == ".mat":
        found = load_variables(path)
        return "ktc" if {"Inj", "Injref", "CurrentPattern"} & set(found) else "eidors"
    if path.suffix in (".csv", ".tsv", ".txt"):
        return "table"
    raise ValueError(f"{path} must end in .h5, .mat, .eit, .csv, .tsv or .txt, or format must be "
                     f"one of {', '.join(READERS)}")


class _Frame(NamedTuple):
    time: float
    """s"""
    frequency: float
    """Hz"""
    amplitude: float
    """A"""
    pairs: list[tuple[int, int]]
    potentials: list[np.ndarray]
    """(L,) V, real parts, for each pair"""


def read_sciospec(path: Path | str) -> Measurements:
    """Read one ``.eit`` file, or all of a folder in the order of their names.

    Potentials refer to the instrument's ground; their real parts, relative to their mean, are
    used. The current enters at the first electrode of a pair with the header's amplitude in A.
    The injections of a frame are spaced evenly until the next frame. ``ValueError`` names the file
    and the fault.
    """
    path = Path(path)
    files = sorted(path.glob("*.eit")) if path.is_dir() else [path]
    if not files:
        raise ValueError(f"{path} must hold .eit files, there are none")
    frames = [_read_frame(file) for file in files]
    first = frames[0]
    for file, frame in zip(files, frames, strict=True):
        if frame.pairs != first.pairs or frame.amplitude != first.amplitude:
            raise ValueError(f"{file} must have the injections of {files[0]}")
    readings = np.array([frame.potentials for frame in frames])
    K, L = readings.shape[1:]
    readings -= readings.mean(axis=2, keepdims=True)
    begins = np.array([frame.time for frame in frames])
    frame_time = float(np.median(np.diff(begins))) if len(frames) > 1 else 1.0
    times = begins[:, None] - begins[0] + frame_time / K * np.arange(K)
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
    # every folder of frames is called setup, so its parent's name tells them apart
    name = f"{path.resolve().parent.name}/{path.name}" if path.is_dir() else path.name
    return Measurements(
        _pair_currents(np.array(first.pairs), first.amplitude, L),
        np.tile(np.arange(K), len(times)), np.eye(L), readings.reshape(-1, L), times.ravel(),
        source={"file": name, "sha256": digest, "frames": len(times), "frequency": first.frequency,
                "assumed": "real parts, relative to the mean of all electrodes; amplitude in A"})


def _pair_currents(pairs: np.ndarray, current: float, L: int) -> np.ndarray:
    """(K, L) A of ``current`` that enters and leaves at pairs (K, 2) of electrodes from 1."""
    currents = np.zeros((len(pairs), L))
    rows = np.arange(len(pairs))
    currents[rows, pairs[:, 0] - 1] = current
    currents[rows, pairs[:, 1] - 1] = -current
    return currents


def _read_frame(path: Path) -> _Frame:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        header = int(lines[0])
        time = datetime.strptime(lines[TIME].strip(), TIMESTAMP_FORMAT).timestamp()
        frequency, amplitude = float(lines[FREQUENCY]), float(lines[AMPLITUDE])
        channels = next(line for line in lines[:header] if line.startswith(CHANNELS))
        count = len(channels.removeprefix(CHANNELS).split(","))
    except (OSError, UnicodeDecodeError, ValueError, IndexError, StopIteration):
        raise ValueError(f"{path} must begin with the header of a .eit file") from None
    body = lines[header:]
    if not body or len(body) % 2:
        raise ValueError(f"{path} must hold pairs of lines after its header, injection and "
                         f"potentials, got {len(body)} lines")
    frame = _Frame(time, frequency, amplitude, [], [])
    for line, pair, row in zip(itertools.count(header + 1, 2), body[::2], body[1::2], strict=False):
        try:
            enters, leaves = (int(each) for each in pair.split())
            parts = np.array(row.split(), dtype=float)
        except ValueError:
            raise ValueError(f"{path}: line {line} must be two electrodes, and the next one "
                             "numbers with decimal points") from None
        if len(parts) < 2 * count or len(parts) % 2:
            raise ValueError(f"{path}: line {line + 1} must have {2 * count} numbers, "
                             f"two for each of {count} channels, got {len(parts)}")
        if not 1 <= min(enters, leaves) <= max(enters, leaves) <= count:
            raise ValueError(f"{path}: line {line} must name electrodes from 1 to {count}, got "
                             f"{pair!r}")
        frame.pairs.append((enters, leaves))
        frame.potentials.append(parts[:2 * count:2])
    return frame


def read_table(path: Path | str, *, electrodes: int, current: float, time_step: float = 1.0,
               unit: float = 1.0, decimal: str = ".", separator: str | None = None,
               reference_rows: int = 0) -> Measurements:
    """Read a text table with one row per injection.

    Columns are the electrode (from 1) at which ``current`` enters, the electrode at which it
    leaves, and one reading per electrode: its potential, or, if a column title has a ``-``, its
    difference from the next electrode. A first line that does not begin with a number holds the
    titles. Empty fields are NaN. ``ValueError`` names the line and the fault.

    Parameters
    ----------
    path : path
    electrodes : int
        L.
    current : float
        A.
    time_step : float
        s between two rows.
    unit : float
        Readings in V per unit of the table; 1e-3 for mV.
    decimal : "." or ","
    separator : str, optional
        Default: a tab, a semicolon, or else a comma.
    reference_rows : int
        The first rows, complete frames of homogeneous fluid, become the reference.
    """
    path = Path(path)
    L = _check.integer("electrodes", electrodes, low=2)
    _check.number("current", current, low=0.0, open_low=True, units="A")
    _check.number("time_step", time_step, low=0.0, open_low=True, units="s")
    if decimal not in (".", ","):
        raise ValueError(f"decimal must be '.' or ',', got {decimal!r}")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} must be a text file: {error}") from None
    lines = [line for line in text.splitlines() if line.strip()]
    if not lines:
        raise ValueError(f"{path} must hold rows, it is empty")
    if separator is None:
        separator = next((each for each in "\t;" if each in lines[0]), ",")
    if separator == decimal:
        raise ValueError(f"separator must differ from the decimal point, got {separator!r} for "
                         "both")
    titles = lines[0] if not lines[0].split(separator)[0].strip().isdigit() else ""
    rows = [_table_row(path, number, line.split(separator), L, decimal)
            for number, line in enumerate(lines, 1) if number > bool(titles)]
    if not rows:
        raise ValueError(f"{path} must hold rows below its titles, there are none")
    numbers = np.array(rows)
    currents = _pair_currents(numbers[:, :2].astype(int), current, L)
    matrix = np.eye(L)
    readings = unit * numbers[:, 2:]
    if "-" in titles:
        matrix -= np.roll(matrix, 1, axis=1)
    else:
        known = np.isfinite(readings)
        count = np.maximum(known.sum(axis=1, keepdims=True), 1)
        readings -= np.where(known, readings, 0.0).sum(axis=1, keepdims=True) / count
    source = provenance(path, assumed=f"{current:g} A, readings in {unit:g} V")
    R = reference_rows
    times = time_step * np.arange(len(readings) - R)
    found = Measurements.from_sequence(currents[R:], matrix, readings[R:], times, None, source)
    if not R:
        return found
    empty = Measurements.from_sequence(currents[:R], matrix, readings[:R], np.arange(float(R)))
    if not np.array_equal(empty.currents, found.currents):
        raise ValueError("reference_rows must be complete frames of the table's injections, got "
                         f"{R}")
    return Measurements(found.currents, found.injections, matrix, found.readings, times,
                        empty.homogeneous(R), source)


def _table_row(path: Path, number: int, fields: list[str], L: int, decimal: str) -> list[float]:
    if len(fields) != L + 2:
        raise ValueError(f"{path}: line {number} must have {L + 2} columns, two electrodes and {L} "
                         f"readings, got {len(fields)}; check the separator and the decimal point")
    try:
        values = [float(text.strip().replace(decimal, ".") or "nan") for text in fields]
    except ValueError as error:
        raise ValueError(f"{path}: line {number} must hold numbers with the decimal point "
                         f"{decimal!r}: {error}") from None
    if not all(each in range(1, L + 1) for each in values[:2]) or values[0] == values[1]:
        raise ValueError(f"{path}: line {number} must begin with two electrodes from 1 to {L}, got "
                         f"{fields[0].strip()} and {fields[1].strip()}")
    return values


def _table_options(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise ValueError("a table must be described by a YAML file of entries like 'electrodes: "
                         f"16' and 'current: 0.001' (A), there is no {path}")
    options = load_yaml(path, "table")
    known = set(signature(read_table).parameters) - {"path"}
    if not set(options) <= known:
        raise ValueError(f"{path} must have entries of {', '.join(sorted(known))}, got {options!r}")
    if missing := {"electrodes", "current"} - set(options):
        raise ValueError(f"{path} must have {', '.join(sorted(missing))}")
    return options


def load_yaml(path: Path, what: str) -> dict[str, Any]:
    """Load the entries of a YAML file that describes ``what``; ``ValueError`` names the file."""
    with needed_by(f"the YAML file of a {what}"):
        import yaml
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ValueError(f"{what} must be a YAML file, got {path}: {error}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{what} must be a YAML file of entries like 'name: value', got {path}")
    return content


READERS: dict[str, Callable[..., Measurements]] = {
    "hdf5": Measurements.load, "ktc": read_ktc, "eidors": read_eidors,
    "sciospec": read_sciospec, "table": read_table}
