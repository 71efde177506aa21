"""`read` measurements from a file of any supported format; readers of Sciospec files and tables."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np

from eitbench import _check
from eitbench._extras import require_extra
from eitbench.measured.matlab import load_variables, read_eidors, read_ktc
from eitbench.measured.measurements import Measurements, provenance
from eitbench.measured.quality import find_spikes

TIME, LOWEST, HIGHEST, COUNT, AMPLITUDE, MODE = 3, 4, 5, 7, 8, 13
"""Header lines of Sciospec files, from 0: time of the frame, lowest and highest frequency in Hz,
number of frequencies, peak current in A, measurement mode."""
CHANNELS = "MeasurementChannels:"
TIMESTAMP_FORMAT = "%Y.%m.%d. %H:%M:%S.%f"
SINGLE_ENDED, DIFFERENTIAL = "1", "2"
"""Measurement modes: potentials to ground, or differences of neighbouring channels."""
TABLE_VOLTAGES = ("potentials", "neighbours")
DIFFERENCE_TITLE = re.compile(r".*\d\s*[-–]\s*\D*\d+\s*")
"""Title of a column such as ``U1-U2``."""


def read(path: Path | str, format: str | None = None, steps: slice | None = None,
         **options: Any) -> Measurements:
    """Read measurements, or only the measurement vectors ``steps``, from a file or a folder.

    ``format`` is one of `READERS`; by default the suffix and the variables of the file determine
    it. ``options`` are arguments of the reader; a table may have them in a YAML file of the same
    name: ``electrodes: 16`` and ``current: 0.001``, one per line. ``ValueError`` names the file
    and the error.
    """
    path = Path(path)
    if not path.exists():
        raise ValueError(f"{path} must be a file or a folder, got a missing path")
    format = format or _detect_format(path)
    _check.choice("format", format, READERS)
    if format == "table" and "electrodes" not in options:
        options = _table_options(path) | options
    names = set(signature(READERS[format]).parameters) - {"path"}
    if unknown := sorted(set(options) - names):
        raise ValueError(f"options of {path} (format {format}) must be among "
                         f"{', '.join(sorted(names)) or '(none)'}, got {', '.join(unknown)}")
    try:
        measurements = READERS[format](path, **options)
        return measurements if steps is None else measurements.select(steps)
    except ValueError as error:
        if str(path) in str(error):
            raise
        raise ValueError(f"{path}: {error}") from None


def _detect_format(path: Path) -> str:
    if path.suffix == ".dat" or (path.is_dir() and any(path.glob("*.dat"))):
        return "unified"
    if path.is_dir() or path.suffix == ".eit":
        return "sciospec"
    if path.suffix in (".h5", ".hdf5"):
        return "hdf5"
    if path.suffix == ".mat":
        names = {"Inj", "Injref", "CurrentPattern"}
        return "ktc" if names & set(load_variables(path)) else "eidors"
    if path.suffix in (".csv", ".tsv", ".txt"):
        return "table"
    raise ValueError(f"{path} must end in .h5, .mat, .eit, .dat, .csv, .tsv or .txt, or format "
                     f"must be one of {', '.join(READERS)}")


def read_sciospec(path: Path, *, frequency: float | None = None) -> Measurements:
    """Read one ``.eit`` file, or all files of a folder in the order of their names.

    The voltages are the real parts of the potentials relative to the mean of all electrodes, or of
    the differences of neighbouring channels, by the header's measurement mode. The current enters
    at the first electrode of a pair with the header's amplitude in A. The injections of a frame
    are evenly spaced until the next frame. A file of several frequencies requires ``frequency``,
    its lowest or highest one, in Hz.
    """
    files = sorted(path.glob("*.eit")) if path.is_dir() else [path]
    if not files:
        raise ValueError(f"{path} must hold .eit files, got none")
    starts, settings, frames = zip(*(_read_frame(file, frequency) for file in files), strict=True)
    for file, setting in zip(files, settings, strict=True):
        if setting != settings[0]:
            raise ValueError(f"{file} must have the injections, frequency and measurement mode of "
                             f"{files[0]}")
    hertz, amplitude, is_differential, pairs = settings[0]
    voltages = np.array(frames)
    _, K, L = voltages.shape
    matrix = np.eye(L)
    if is_differential:
        matrix -= np.roll(matrix, 1, axis=1)
    else:
        voltages = _relative_to_mean(voltages.reshape(-1, L), np.tile(np.arange(K), len(files)))
    frame_time = float(np.median(np.diff(starts))) if len(files) > 1 else 1.0
    times = np.subtract(starts, starts[0])[:, None] + frame_time / K * np.arange(K)
    return Measurements(
        _pair_currents(np.array(pairs), amplitude, L), np.tile(np.arange(K), len(files)),
        matrix, voltages.reshape(-1, L), times.ravel(),
        source=provenance(path, frames=len(files), frequency=hertz,
                          assumed="real parts; amplitude in A"))


def _relative_to_mean(potentials: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return potentials (T, L) relative to the mean of all electrodes, for injections ``index``. In
    the mean, a missing potential or a spike is replaced by the median of this channel over the
    repetitions of the injection, if there is one."""
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):     # rows of NaN
        potentials = potentials - np.nanmedian(potentials, axis=1, keepdims=True)
        known = np.where(find_spikes(potentials, index), np.nan, potentials)
        for k in np.unique(index):
            typical = np.nanmedian(known[index == k], axis=0)
            change = np.nanmean(known[index == k] - typical, axis=1, keepdims=True)
            potentials[index == k] -= change + np.nanmean(typical)
    return potentials


def _pair_currents(pairs: np.ndarray, current: float, L: int) -> np.ndarray:
    """Return currents (K, L) in A that enter and leave at pairs (K, 2) of electrodes from 1."""
    into, out = np.eye(L)[pairs.T - 1]
    return current * (into - out)


def _read_frame(path: Path, frequency: float | None) -> tuple[
        float, tuple[float, float, bool, list[list[int]]], np.ndarray]:
    """Return the time in s; frequency in Hz, amplitude in A, whether the channels are differences,
    and electrode pairs; real parts (K, L) in V."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        header = int(lines[0])
        stamp = lines[TIME].strip()
        stamp += ".0" * (stamp.count(".") < 4)                              # a whole second
        time = datetime.strptime(stamp, TIMESTAMP_FORMAT).timestamp()
        low, high, amplitude = (float(lines[at]) for at in (LOWEST, HIGHEST, AMPLITUDE))
        n_frequencies, mode = int(lines[COUNT]), lines[MODE].strip()
        channels = next(line for line in lines[:header] if line.startswith(CHANNELS))
        count = len(channels.removeprefix(CHANNELS).split(","))
    except (OSError, UnicodeDecodeError, ValueError, IndexError, StopIteration):
        raise ValueError(f"{path} must begin with the header of a .eit file") from None
    if mode not in (SINGLE_ENDED, DIFFERENTIAL):
        raise ValueError(f"{path} must have the measurement mode {SINGLE_ENDED} (single-ended) or "
                         f"{DIFFERENTIAL} (differential), got {mode}")
    if frequency is None and n_frequencies == 1:
        frequency = low
    indices = {low: 0, high: n_frequencies - 1}         # the header does not list those between
    if frequency not in indices:
        raise ValueError(f"{path} holds {n_frequencies} frequencies from {low:g} to {high:g} Hz: "
                         f"frequency must be {low:g} or {high:g}, got {frequency}")
    index = indices[frequency]
    body = [line.split() for line in lines[header:]]
    try:
        pairs = np.array(body[::1 + n_frequencies], dtype=int)
        parts = np.array(body[1 + index::1 + n_frequencies], dtype=float)
        is_valid = (pairs.shape == (len(parts), 2) and parts.shape[1] >= 2 * count
                    and len(body) == len(pairs) * (1 + n_frequencies)
                    and pairs.min() >= 1 and pairs.max() <= count)
    except (ValueError, IndexError):                    # lines of different lengths, text, or none
        is_valid = False
    if not is_valid:
        raise ValueError(f"{path} must hold blocks of lines after its header: two electrodes from "
                         f"1 to {count}, and for each frequency ({n_frequencies}) {2 * count} "
                         "numbers with decimal points, two for each channel")
    return (time, (frequency, amplitude, mode == DIFFERENTIAL, pairs.tolist()),
            parts[:, :2 * count:2])


def read_unified(path: Path, *, current: float = 1.0, frame_time: float = 1.0) -> Measurements:
    """Read one ``.dat`` file of pyGIMLi's unified data format, or all files of a folder in the
    order of their names, each a frame with the same electrodes.

    A row holds the electrodes ``a``, ``b`` of the current and ``m``, ``n`` of the voltage, from 1,
    and the resistance ``r`` in Ω. Rows whose entry ``valid`` is 0 are missing. The files state
    neither the current nor times: voltages are for ``current`` in A, and frames follow
    each other after ``frame_time`` in s.
    """
    _check.number("current", current, low=0.0, open_low=True, units="A")
    _check.number("frame_time", frame_time, low=0.0, open_low=True, units="s")
    files = sorted(path.glob("*.dat")) if path.is_dir() else [path]
    counts, frames = zip(*map(_read_unified_frame, files), strict=True)
    L = counts[0]
    if wrong := [file for file, count in zip(files, counts, strict=True) if count != L]:
        raise ValueError(f"{wrong[0]} must have the {L} electrodes of {files[0]}")
    rows = np.concatenate([pairs for pairs, _ in frames])
    injections, injection = np.unique(rows[:, :2], axis=0, return_inverse=True)
    channels, channel = np.unique(rows[:, 2:], axis=0, return_inverse=True)
    F, K = len(files), len(injections)
    voltages = np.full((F, K, len(channels)), np.nan)
    frame = np.repeat(np.arange(F), [len(pairs) for pairs, _ in frames])
    voltages[frame, injection.ravel(), channel.ravel()] = current * np.concatenate(
        [resistance for _, resistance in frames])
    positive, negative = np.eye(L)[channels.T - 1]
    times = frame_time * (np.arange(F)[:, None] + np.arange(K) / K)
    return Measurements(
        _pair_currents(injections, current, L), np.tile(np.arange(K), F), positive - negative,
        voltages.reshape(F * K, -1), times.ravel(),
        source=provenance(path, frames=F, assumed=f"{current:g} A, a frame in {frame_time:g} s"))


def _read_unified_frame(path: Path) -> tuple[int, tuple[np.ndarray, np.ndarray]]:
    """Return the number of electrodes L, the electrodes a, b, m, n (N, 4) from 1, and the
    resistances (N,) in Ω, NaN where invalid."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        content = [line for line in lines if line.strip() and not line.lstrip().startswith("#")]
        L = int(content[0].partition("#")[0])
        N = int(content[L + 1].partition("#")[0])
        head = next(line for line in reversed(lines[:lines.index(content[L + 2])])
                    if line.startswith("#"))
        names = head.lstrip("#").lower().split()
        table = np.array([line.split()[:len(names)] for line in content[L + 2:L + 2 + N]], float)
        columns = dict(zip(names, table.T, strict=True))
        pairs = np.stack([columns[name] for name in "abmn"], axis=1).astype(int)
        resistance = np.where(columns.get("valid", 1.0) == 0, np.nan, columns["r"])
    except (OSError, ValueError, IndexError, StopIteration, KeyError) as error:
        raise ValueError(f"{path} must have pyGIMLi's unified format: the number of electrodes and "
                         "their positions, the number of rows, a line such as '# a b m n r', and "
                         f"the rows ({type(error).__name__}: {error})") from None
    if pairs.min() < 1 or pairs.max() > L:
        raise ValueError(f"{path}: a, b, m and n must be electrodes from 1 to {L}, got "
                         f"{pairs.min()} to {pairs.max()}")
    return L, (pairs, resistance)


def read_table(path: Path, *, electrodes: int, current: float, time_step: float = 1.0,
               unit: float = 1.0, decimal: str = ".", separator: str | None = None,
               reference_rows: int = 0, readings: str | None = None) -> Measurements:
    """Read a text table with one row per injection.

    Columns are the electrode (from 1) at which ``current`` enters, the electrode at which it
    leaves, and one voltage per electrode. A first line that does not begin with a number holds the
    titles. Empty fields are NaN.

    Parameters
    ----------
    electrodes : int
        Number of electrodes L.
    current : float
        Amplitude in A.
    time_step : float
        Time between two rows in s.
    unit : float
        V per unit of the table; 1e-3 for mV.
    decimal : "." or ","
    separator : str, optional
        Default: a tab or a semicolon if the first line contains one, else a comma.
    reference_rows : int
        Number of first rows that become the reference: complete frames of homogeneous fluid.
    readings : "potentials" or "neighbours", optional
        Voltage l is the potential U_l of electrode l, or the difference U_l − U_(l+1).
        Default: differences if all titles are such as ``U1-U2``, else potentials.
    """
    if readings is not None:
        _check.choice("readings", readings, TABLE_VOLTAGES)
    L = _check.integer("electrodes", electrodes, low=2)
    _check.number("current", current, low=0.0, open_low=True, units="A")
    _check.number("time_step", time_step, low=0.0, open_low=True, units="s")
    _check.number("unit", unit, low=0.0, open_low=True, units="V")
    R = _check.integer("reference_rows", reference_rows, low=0)
    pairs, voltages, titles = _read_rows(path, L, decimal, separator)
    if readings is None:
        readings = TABLE_VOLTAGES[bool(titles and all(map(DIFFERENCE_TITLE.fullmatch, titles)))]
    voltages *= unit
    matrix = np.eye(L)
    if readings == "neighbours":
        matrix -= np.roll(matrix, 1, axis=1)
    else:
        index = np.unique(pairs, axis=0, return_inverse=True)[1].reshape(-1)
        voltages = _relative_to_mean(voltages, index)
    measurements = Measurements.from_sequence(
        _pair_currents(pairs, current, L), matrix, voltages, time_step * np.arange(len(voltages)),
        source=provenance(path, assumed=f"{current:g} A, voltages in {unit:g} V"))
    if not R:
        return measurements
    index = measurements.injection_index
    if set(index[:R]) != set(index[R:]):
        raise ValueError("reference_rows must be complete frames of the table's injections, got "
                         f"{R}")
    return replace(measurements.select(slice(R, None)), times=measurements.times[:-R],
                   reference=measurements.select(slice(R)).reference_frames(R))


def _read_rows(path: Path, L: int, decimal: str,
               separator: str | None) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return electrode pairs (T, 2) from 1, voltages (T, L), and the titles of the voltages."""
    if decimal not in (".", ","):
        raise ValueError(f"decimal must be '.' or ',', got {decimal!r}")
    try:
        lines = list(filter(str.strip, path.read_text(encoding="utf-8-sig").splitlines()))
        if separator is None:
            separator = next((each for each in "\t;" if each in "".join(lines[:1])), ",")
        if separator == decimal:
            raise ValueError(f"separator must differ from the decimal point, got {separator!r} for "
                             "both")
        titles: list[str] = []
        if lines and not _is_number(first := lines[0].split(separator)[0], decimal):
            titles = lines.pop(0).split(separator)[2:] or [first]
        if not lines:
            raise ValueError("it must hold rows, got none")
        numbers = np.loadtxt(
            lines, delimiter=separator, comments=None, ndmin=2,
            converters=lambda text: float(text.strip().replace(decimal, ".") or "nan"))
        if numbers.shape[1] != L + 2:
            raise ValueError(f"rows must have {L + 2} columns, two electrodes and {L} voltages, "
                             f"got {numbers.shape[1]}")
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} must be a text table of numbers with the decimal point "
                         f"{decimal!r} and the separator {separator!r}: {error}") from None
    ends = numbers[:, :2]
    valid = np.isin(ends, range(1, L + 1)).all(axis=1) & (ends[:, 0] != ends[:, 1])
    if not valid.all():
        row = int(valid.argmin())
        raise ValueError(f"{path}: row {row + 1} must begin with two electrodes from 1 to {L}, got "
                         f"{ends[row, 0]:g} and {ends[row, 1]:g}")
    return ends.astype(int), numbers[:, 2:], titles


def _is_number(text: str, decimal: str) -> bool:
    try:
        float(text.strip().replace(decimal, "."))
    except ValueError:
        return False
    return True


def _table_options(table: Path) -> dict[str, Any]:
    """Load ``TABLE.csv.yml`` or ``TABLE.yml``; a file with ``kind`` describes a vessel instead."""
    path = next((each for each in (table.with_name(table.name + ".yml"), table.with_suffix(".yml"))
                 if each.is_file() and "kind" not in load_yaml(each, "table")), None)
    if path is None:
        raise ValueError("a table must be described by a YAML file of entries like 'electrodes: "
                         f"16' and 'current: 0.001' (A), got neither {table.name}.yml nor a "
                         f"{table.stem}.yml of a table in the folder of {table}")
    options = load_yaml(path, "table")
    if missing := {"electrodes", "current"} - set(options):
        raise ValueError(f"{path} must have {', '.join(sorted(missing))}")
    return options


def load_yaml(path: Path, subject: str) -> dict[str, Any]:
    """Load the entries of a YAML file that describes ``subject``; ``ValueError`` names the file."""
    with require_extra(f"the YAML file of a {subject}"):
        import yaml
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ValueError(f"{subject} must be a YAML file, got {path}: {error}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{subject} must be a YAML file of entries like 'name: value', got {path}")
    return {name: float(value) if isinstance(value, str) and _is_number(value, ".") else value
            for name, value in content.items()}                         # YAML reads 2e-3 as text


READERS: dict[str, Callable[..., Measurements]] = {
    "hdf5": Measurements.load, "ktc": read_ktc, "eidors": read_eidors,
    "sciospec": read_sciospec, "unified": read_unified, "table": read_table}
