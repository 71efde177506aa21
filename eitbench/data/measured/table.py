"""Tables of readings: one row an injection, one column a reading."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from eitbench import _check
from eitbench.data.measured.measurements import Measurements


def read(path: Path | str, *, electrodes: int, current: float, time_step: float = 1.0,
         unit: float = 1.0, decimal: str = ".", separator: str | None = None,
         reference_rows: int = 0) -> Measurements:
    """A text table, three lines of description for it, and no more.

    Columns are: the electrode (from 1) at which ``current`` enters, that at which it leaves, and
    the readings: as many as ``electrodes``, which are potentials, or differences of neighbours, one
    for each electrode l against l + 1 if one of the column titles has a ``-``. A first line that
    begins with no number is the titles. Empty fields are missing readings. ``ValueError`` naming
    the line that is wrong.

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
        V in a unit of the readings; 1e-3 for mV.
    decimal : "." or ","
    separator : str, optional
        Between columns; by default a tab, a semicolon, or a comma if that is not the decimal point.
    reference_rows : int
        First rows that are homogeneous fluid, and no part of the record: whole frames.
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
        raise ValueError("separator must be another than the decimal point, got "
                         f"{separator!r} for both")
    titles = lines[0] if not lines[0].split(separator)[0].strip().isdigit() else ""
    rows = [_row(path, number, line.split(separator), L, decimal)
            for number, line in enumerate(lines, 1) if number > bool(titles)]
    if not rows:
        raise ValueError(f"{path} must hold rows below its titles, there are none")
    numbers = np.array(rows)
    currents = np.zeros((len(numbers), L))
    at = np.arange(len(numbers))
    currents[at, numbers[:, 0].astype(int) - 1] = current
    currents[at, numbers[:, 1].astype(int) - 1] = -current
    matrix = np.eye(L)
    readings = unit * numbers[:, 2:]
    if "-" in titles:
        matrix = matrix - np.roll(matrix, 1, axis=1)
    else:
        there = np.isfinite(readings)
        count = np.maximum(there.sum(axis=1, keepdims=True), 1)
        readings = readings - np.where(there, readings, 0.0).sum(axis=1, keepdims=True) / count
    source = {"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
              "assumed": f"{current:g} A, readings in {unit:g} V"}
    keep = slice(reference_rows, None)
    times = time_step * np.arange(len(readings) - reference_rows)
    whole = Measurements.of_sequence(currents[keep], matrix, readings[keep], times, None, source)
    if not reference_rows:
        return whole
    empty = Measurements.of_sequence(currents[:reference_rows], matrix, readings[:reference_rows],
                                     np.arange(float(reference_rows)))
    if not np.array_equal(empty.currents, whole.currents):
        raise ValueError(f"reference_rows must be whole frames of the record's injections, got "
                         f"{reference_rows}")
    return Measurements(whole.currents, whole.injections, matrix, whole.readings, times,
                        empty.homogeneous(len(empty.readings)), source)


def _row(path: Path, number: int, fields: list[str], L: int, decimal: str) -> list[float]:
    if len(fields) != L + 2:
        raise ValueError(f"{path}: line {number} must have {L + 2} columns, two electrodes and {L} "
                         f"readings, got {len(fields)}; is the separator or the decimal point "
                         "another?")
    try:
        values = [float(each.strip().replace(decimal, ".")) if each.strip() else np.nan
                  for each in fields]
    except ValueError:
        raise ValueError(f"{path}: line {number} must hold numbers with the decimal point "
                         f"{decimal!r}, got {separator_free(fields)}") from None
    if not all(each in range(1, L + 1) for each in values[:2]) or values[0] == values[1]:
        raise ValueError(f"{path}: line {number} must begin with two electrodes from 1 to {L}, got "
                         f"{fields[0].strip()} and {fields[1].strip()}")
    return values


def separator_free(fields: list[str]) -> str:
    """The first field that is no number."""
    for each in fields:
        try:
            float(each)
        except ValueError:
            return repr(each.strip())
    return repr(fields[0])
