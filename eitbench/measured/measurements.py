"""`Measurements`: currents, readings and times of an instrument, with units, in one HDF5 file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from eitbench import _check
from eitbench._extras import needed_by
from eitbench._files import replacing

FORMAT = "eitbench measurements"
VERSION = 1
REQUIRED = ("currents", "injections", "matrix", "readings", "times")
"""Data sets of a file; ``reference`` is optional."""
MAX_IN_MEMORY_BYTES = 1 << 26
CURRENT_BALANCE_RTOL = 1e-6
"""Tolerated sum of the currents of an injection, relative to its largest current."""


@dataclass(frozen=True, eq=False)
class Measurements:
    """T readings of M numbers each, during K different injections by L electrodes.

    Writable arrays are copied; read-only ones, such as the readings of a large file, are not
    (`load`). Currents whose sum differs from zero by rounding are reduced by their mean.
    ``ValueError`` names a field of the wrong shape, without numbers, or in contradiction to
    another.
    """

    currents: np.ndarray
    """(K, L) A into each electrode, each injection once; rows sum to zero"""
    injections: np.ndarray
    """(T,) int, index of the active injection"""
    matrix: np.ndarray
    """(M, L) maps potentials, relative to the mean of all electrodes, to readings"""
    readings: np.ndarray
    """(T, M) V, NaN where nothing was measured"""
    times: np.ndarray
    """(T,) s, increasing"""
    reference: np.ndarray | None = None
    """(F, K, M) V, F frames of homogeneous fluid; NaN where nothing was measured"""
    source: Mapping[str, Any] = field(default_factory=dict)
    """JSON-ready provenance: file, instrument, licence, frequency, assumed units"""

    def __post_init__(self) -> None:
        currents = _balanced(_check.array("currents", self.currents, (None, None), units="A"))
        K, L = currents.shape
        matrix = _check.array("matrix", self.matrix, (None, L))
        M = len(matrix)
        readings = _check_readings("readings", self.readings, (None, M))
        T = len(readings)
        times = _check.array("times", self.times, (T,), units="s")
        if (back := np.flatnonzero(np.diff(times) <= 0)).size:
            before, after = times[back[0]:back[0] + 2]
            raise ValueError(f"times must increase, got {before:g} s and then {after:g} s at "
                             f"reading {back[0] + 1}")
        arrays = {"currents": currents, "injections": _check_indices(self.injections, T, K),
                  "matrix": matrix, "readings": readings, "times": times}
        if self.reference is not None:
            arrays["reference"] = _check_readings("reference", self.reference, (None, K, M))
        json.dumps(dict(self.source), allow_nan=False)
        for name, value in arrays.items():
            if value.flags.writeable:
                value = value.copy()
                value.setflags(write=False)
            object.__setattr__(self, name, value)

    @classmethod
    def from_sequence(cls, currents: np.ndarray, matrix: np.ndarray, readings: np.ndarray,
                      times: np.ndarray, reference: np.ndarray | None = None,
                      source: Mapping[str, Any] | None = None) -> Measurements:
        """Merge equal rows of ``currents`` (T, L), one row a reading, into one injection each;
        ``reference`` (F, T, M) has the same order."""
        currents = _check.array("currents", currents, (None, None), units="A")
        distinct, first, inverse = np.unique(currents, axis=0, return_index=True,
                                             return_inverse=True)
        order = np.argsort(first)                              # order of first use
        injections = np.argsort(order)[inverse.reshape(-1)]
        if reference is not None:
            reference = _check_readings("reference", reference, (None, len(currents), None))
            reference = _by_injection(reference, injections, len(distinct))
        return cls(distinct[order], injections, matrix, readings, times, reference, source or {})

    @cached_property
    def frame(self) -> int:
        """Number of readings until each injection has been active once."""
        return 1 + int(np.unique(self.injections, return_index=True)[1].max())

    @cached_property
    def largest(self) -> float:
        """Largest magnitude of all readings in V."""
        return float(max(np.fmax.reduce(self.readings, axis=None),
                         -np.fmin.reduce(self.readings, axis=None)))

    def homogeneous(self, frames: int = 1) -> np.ndarray:
        """(F, K, M) V: the reference, or without one the first ``frames`` frames."""
        if self.reference is not None:
            return self.reference
        return self._sorted(slice(_check.integer("frames", frames, low=1) * self.frame))

    def frames(self, most: int) -> np.ndarray:
        """(F, K, M) V: the first ``most`` complete frames; NaN where nothing was measured."""
        count = min(max(len(self.readings) // self.frame, 1), most)
        return np.concatenate([self._sorted(slice(k * self.frame, (k + 1) * self.frame))
                               for k in range(count)])

    def _sorted(self, steps: slice) -> np.ndarray:
        return _by_injection(self.readings[None, steps], self.injections[steps],
                             len(self.currents))

    def select(self, steps: slice) -> Measurements:
        """Return consecutive readings with the injections that they use."""
        injections = self.injections[steps]
        if not injections.size:
            raise ValueError(f"steps must hold readings of the {len(self.injections)}, got {steps}")
        used = np.unique(injections)
        reference = None if self.reference is None else self.reference[:, used]
        return Measurements(self.currents[used], np.searchsorted(used, injections), self.matrix,
                            self.readings[steps], self.times[steps], reference, self.source)

    def save(self, path: Path | str) -> Path:
        """Write one HDF5 file atomically; needs the extra ``export``."""
        with needed_by("a file of measurements"):
            import h5py
        path = Path(path)
        with replacing(path) as temporary, h5py.File(temporary, "w") as file:
            file.attrs.update(format=FORMAT, version=VERSION, source=json.dumps(dict(self.source)))
            for name in (*REQUIRED, "reference"):
                if (value := getattr(self, name)) is not None:
                    file.create_dataset(name, data=value)
        return path

    @classmethod
    def load(cls, path: Path | str, steps: slice = slice(None)) -> Measurements:
        """Read a file of `save`, or only the readings ``steps`` of it.

        Data sets of more than `MAX_IN_MEMORY_BYTES` are memory-mapped; their file must not
        change. ``ValueError`` names the file and the fault.
        """
        with needed_by("a file of measurements"):
            import h5py
        path = Path(path)
        try:
            with h5py.File(path, "r") as file:
                found = file.attrs.get("format"), file.attrs.get("version")
                if found != (FORMAT, VERSION):
                    raise ValueError(f"format must be {FORMAT!r}, version {VERSION}, got "
                                     f"{found[0]!r}, version {found[1]!r}")
                if missing := [name for name in REQUIRED if name not in file]:
                    raise ValueError(f"{', '.join(missing)} must be data sets of the file")
                content = {name: file[name][()] for name in ("currents", "matrix", "reference")
                           if name in file}
                content |= {name: _rows(path, file[name], steps)
                            for name in ("injections", "times", "readings")}
                if not content["injections"].size:
                    raise ValueError("steps must hold some of its "
                                     f"{len(file['injections'])} readings, got {steps}")
                source = json.loads(file.attrs["source"])
            return cls(**content, source=source)
        except (OSError, KeyError, ValueError, TypeError) as error:
            raise ValueError(f"{path} must be a file of measurements: {error}") from None


def _rows(path: Path, dataset: Any, steps: slice) -> np.ndarray:
    """Read rows of a data set, or map them if they are large, contiguous and of native type."""
    large = dataset.size * dataset.dtype.itemsize > MAX_IN_MEMORY_BYTES
    offset = dataset.id.get_offset()                 # None if it is compressed or chunked
    if large and offset is not None and dataset.dtype in (np.float64, np.int64):
        return np.memmap(path, dataset.dtype, "r", offset, dataset.shape)[steps]
    rows: np.ndarray = dataset[steps]
    rows.setflags(write=False)                       # avoids a copy in __post_init__
    return rows


def _by_injection(sequences: np.ndarray, injections: np.ndarray, K: int) -> np.ndarray:
    """Sort F sequences (F, T, M) by injection into (F·R, K, M), with R the largest number of
    repetitions of an injection and NaN where an injection has fewer."""
    F, T, M = sequences.shape
    turn = np.zeros(T, dtype=int)
    for k in np.unique(injections):
        turn[injections == k] = np.arange(np.count_nonzero(injections == k))
    repetitions = 1 + int(turn.max())
    found = np.full((F, repetitions, K, M), np.nan)
    found[:, turn, injections] = sequences
    return found.reshape(F * repetitions, K, M)


def _balanced(currents: np.ndarray) -> np.ndarray:
    """Check (K, L) injections and subtract what rounding leaves of their sums."""
    sums = currents.sum(axis=1)
    largest = np.abs(currents).max(axis=1)
    if not largest.all():
        raise ValueError(f"currents must flow, got none in injection {int(largest.argmin())}")
    if (wrong := np.flatnonzero(np.abs(sums) > CURRENT_BALANCE_RTOL * largest)).size:
        raise ValueError("currents must sum to zero over the electrodes, got "
                         f"{sums[wrong[0]]:g} A in injection {wrong[0]}")
    on = currents != 0.0
    currents = currents - on * (sums / on.sum(axis=1))[:, None]
    if len(np.unique(currents, axis=0)) < len(currents):
        raise ValueError(f"currents must be {len(currents)} different injections, got duplicates; "
                         "see Measurements.from_sequence")
    return currents


def _check_indices(given: np.ndarray, T: int, K: int) -> np.ndarray:
    injections = np.asarray(given)
    if injections.shape != (T,) or not np.issubdtype(injections.dtype, np.integer):
        raise ValueError(f"injections must be {T} integers, one per reading, got "
                         f"{injections.dtype} of shape {injections.shape}")
    if injections.min() < 0 or injections.max() >= K:
        raise ValueError(f"injections must be numbers from 0 to {K - 1}, got "
                         f"{injections.min()} to {injections.max()}")
    return injections.astype(np.int64, copy=False)


def _check_readings(name: str, given: np.ndarray, shape: tuple[int | None, ...]) -> np.ndarray:
    """Return an array of this shape whose entries are finite or NaN, not all of them NaN."""
    value = _check.array(name, given, shape, units="V", allow_nan=True)
    if np.isnan(value).all():
        raise ValueError(f"{name} must hold numbers, got NaN only")
    return value
