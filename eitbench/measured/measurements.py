"""`Measurements`: currents, voltages and times of an instrument, in SI units, in one HDF5 file."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from eitbench import _check
from eitbench._extras import require_extra
from eitbench._files import atomic_path

FILE_FORMAT, FORMAT_VERSION = "eitbench measurements", 1
DATASETS = {"currents": "currents", "injection_index": "injections", "matrix": "matrix",
            "voltages": "readings", "times": "times"}
"""Field -> required data set of a file; ``reference`` is optional."""
MAX_IN_MEMORY_BYTES = 1 << 26
CURRENT_BALANCE_RTOL = 1e-6
"""Tolerated sum of the currents of an injection, relative to its largest current."""


@dataclass(frozen=True, eq=False)
class Measurements:
    """T measurement vectors (M,) of K different injections through L electrodes.

    Writable arrays are copied; read-only arrays, such as the voltages of a large file, are not
    (`load`). The mean of the currents of an injection is subtracted if it is a rounding error.
    ``ValueError`` names a field that has a wrong shape, holds no numbers, or contradicts another.
    """

    currents: np.ndarray
    """(K, L) A into each electrode, each injection once; rows sum to zero"""
    injection_index: np.ndarray
    """(T,) int, row of ``currents`` that is active"""
    matrix: np.ndarray
    """(M, L) maps potentials, relative to the mean of all electrodes, to measured voltages"""
    voltages: np.ndarray
    """(T, M) V, NaN where nothing was measured"""
    times: np.ndarray
    """(T,) s, increasing"""
    reference: np.ndarray | None = None
    """(F, K, M) V, F frames of homogeneous fluid; NaN where nothing was measured"""
    source: Mapping[str, Any] = field(default_factory=dict)
    """JSON-ready provenance: file, instrument, licence, frequency, assumed units"""

    def __post_init__(self) -> None:
        currents = _balance(_check.array("currents", self.currents, (None, None), units="A"))
        K, L = currents.shape
        matrix = _check.array("matrix", self.matrix, (None, L))
        M = len(matrix)
        voltages = check_voltages("voltages", self.voltages, (None, M))
        T = len(voltages)
        times = _check.array("times", self.times, (T,), units="s")
        if (back := np.flatnonzero(np.diff(times) <= 0)).size:
            before, after = times[back[0]:back[0] + 2]
            raise ValueError(f"times must increase, got {before:g} s and then {after:g} s at "
                             f"index {back[0] + 1}")
        index = _check_index(self.injection_index, T, K)
        arrays = {"currents": currents, "injection_index": index, "matrix": matrix,
                  "voltages": voltages, "times": times}
        if self.reference is not None:
            arrays["reference"] = check_voltages("reference", self.reference, (None, K, M))
        json.dumps(dict(self.source), allow_nan=False)
        for name, value in arrays.items():
            if value.flags.writeable:
                value = value.copy()
                value.setflags(write=False)
            object.__setattr__(self, name, value)

    @classmethod
    def from_sequence(cls, currents: np.ndarray, matrix: np.ndarray, voltages: np.ndarray,
                      times: np.ndarray, reference: np.ndarray | None = None,
                      source: Mapping[str, Any] | None = None) -> Measurements:
        """Merge equal rows of ``currents`` (T, L) into one injection each; ``reference`` (F, T, M)
        has the order of ``currents``."""
        currents = _check.array("currents", currents, (None, None), units="A")
        distinct, first, inverse = np.unique(currents, axis=0, return_index=True,
                                             return_inverse=True)
        order = np.argsort(first)                              # order of first use
        index = np.argsort(order)[inverse.reshape(-1)]
        if reference is not None:
            reference = check_voltages("reference", reference, (None, len(currents), None))
            reference = _sort_by_injection(reference, index, len(distinct))
        return cls(distinct[order], index, matrix, voltages, times, reference, source or {})

    @cached_property
    def frame_length(self) -> int:
        """Number of measurement vectors until each injection has been active once."""
        return 1 + int(np.unique(self.injection_index, return_index=True)[1].max())

    @cached_property
    def max_abs_voltage(self) -> float:
        """Largest magnitude of all measurements in V."""
        return float(max(np.fmax.reduce(self.voltages, axis=None),
                         -np.fmin.reduce(self.voltages, axis=None)))

    def reference_frames(self, n_frames: int = 1) -> np.ndarray:
        """Return the reference (F, K, M) in V, or without one the first ``n_frames`` frames."""
        if self.reference is not None:
            return self.reference
        n_frames = _check.integer("n_frames", n_frames, low=1)
        return self._sorted(slice(n_frames * self.frame_length))

    def frames(self, n_max: int) -> np.ndarray:
        """Return the first ``n_max`` complete frames, (F, K, M) in V."""
        count = min(max(len(self.voltages) // self.frame_length, 1), n_max)
        return np.concatenate([self._sorted(slice(k * self.frame_length,
                                                  (k + 1) * self.frame_length))
                               for k in range(count)])

    def _sorted(self, steps: slice) -> np.ndarray:
        return _sort_by_injection(self.voltages[None, steps], self.injection_index[steps],
                                  len(self.currents))

    def select(self, steps: slice) -> Measurements:
        """Return consecutive measurement vectors with the injections that they use."""
        index = self.injection_index[steps]
        if not index.size:
            raise ValueError(f"steps must select some of the {len(self.voltages)} measurement "
                             f"vectors, got {steps}")
        used = np.unique(index)
        reference = None if self.reference is None else self.reference[:, used]
        return Measurements(self.currents[used], np.searchsorted(used, index), self.matrix,
                            self.voltages[steps], self.times[steps], reference, self.source)

    def save(self, path: Path | str) -> Path:
        """Write one HDF5 file atomically; requires the extra ``export``."""
        with require_extra("a file of measurements"):
            import h5py
        path = Path(path)
        with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
            file.attrs.update(format=FILE_FORMAT, version=FORMAT_VERSION,
                              source=json.dumps(dict(self.source)))
            for name, dataset in (DATASETS | {"reference": "reference"}).items():
                if (value := getattr(self, name)) is not None:
                    file.create_dataset(dataset, data=value)
        return path

    @classmethod
    def load(cls, path: Path | str) -> Measurements:
        """Read a file of `save`.

        Data sets of more than `MAX_IN_MEMORY_BYTES` are memory-mapped; their file must not
        change. ``ValueError`` names the file and the error.
        """
        with require_extra("a file of measurements"):
            import h5py
        path = Path(path)
        try:
            with h5py.File(path, "r") as file:
                version = file.attrs.get("format"), file.attrs.get("version")
                if version != (FILE_FORMAT, FORMAT_VERSION):
                    raise ValueError(f"format must be {FILE_FORMAT!r}, version {FORMAT_VERSION}, "
                                     f"got {version[0]!r}, version {version[1]!r}")
                if missing := set(DATASETS.values()) - set(file):
                    raise ValueError(f"{', '.join(sorted(missing))} must be data sets of the file")
                content = {name: file[name][()] for name in ("currents", "matrix", "reference")
                           if name in file}
                content |= {name: _read_rows(path, file[DATASETS[name]])
                            for name in ("injection_index", "times", "voltages")}
                source = json.loads(file.attrs["source"])
            return cls(**content, source=source)
        except (OSError, KeyError, ValueError, TypeError) as error:
            raise ValueError(f"{path} must be a file of measurements: {error}") from None


def file_sha256(path: Path) -> str:
    """Return the digest of a file, or of all files of a folder in the order of their names."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    digest = hashlib.sha256()
    for each in filter(Path.is_file, files):
        with each.open("rb") as stream:
            hashlib.file_digest(stream, lambda: digest)
    return digest.hexdigest()


def provenance(path: Path, **entries: Any) -> dict[str, Any]:
    """Return the name and sha256 of a file or a folder, and further ``entries``."""
    # every Sciospec folder of frames is called setup; its parent's name identifies it
    name = f"{path.resolve().parent.name}/{path.name}" if path.is_dir() else path.name
    return {"file": name, "sha256": file_sha256(path), **entries}


def _read_rows(path: Path, dataset: Any) -> np.ndarray:
    """Read a data set, or map them if they are large, contiguous and of native type."""
    large = dataset.size * dataset.dtype.itemsize > MAX_IN_MEMORY_BYTES
    offset = dataset.id.get_offset()                 # None if it is compressed or chunked
    if large and offset is not None and dataset.dtype in (np.float64, np.int64):
        return np.memmap(path, dataset.dtype, "r", offset, dataset.shape)
    rows: np.ndarray = dataset[()]
    rows.setflags(write=False)                       # avoids a copy in __post_init__
    return rows


def _sort_by_injection(sequences: np.ndarray, index: np.ndarray, K: int) -> np.ndarray:
    """Sort F sequences (F, T, M) by injection into (F·R, K, M), with R the largest number of
    repetitions of an injection; NaN for missing repetitions."""
    F, T, M = sequences.shape
    repetition = np.zeros(T, dtype=int)
    for k in np.unique(index):
        repetition[index == k] = np.arange(np.count_nonzero(index == k))
    R = 1 + int(repetition.max())
    frames = np.full((F, R, K, M), np.nan)
    frames[:, repetition, index] = sequences
    return frames.reshape(F * R, K, M)


def _balance(currents: np.ndarray) -> np.ndarray:
    """Check injections (K, L), and subtract the rounding error of their sums."""
    sums = currents.sum(axis=1)
    largest = np.abs(currents).max(axis=1)
    if not largest.all():
        raise ValueError("currents must not be 0 at all electrodes, got injection "
                         f"{int(largest.argmin())}")
    if (wrong := np.flatnonzero(np.abs(sums) > CURRENT_BALANCE_RTOL * largest)).size:
        raise ValueError("currents must sum to zero over the electrodes, got "
                         f"{sums[wrong[0]]:g} A in injection {wrong[0]}")
    on = currents != 0.0
    currents = currents - on * (sums / on.sum(axis=1))[:, None]
    if len(np.unique(currents, axis=0)) < len(currents):
        raise ValueError(f"currents must be {len(currents)} different injections, got duplicates; "
                         "see Measurements.from_sequence")
    return currents


def _check_index(value: np.ndarray, T: int, K: int) -> np.ndarray:
    index = np.asarray(value)
    if index.shape != (T,) or not np.issubdtype(index.dtype, np.integer):
        raise ValueError(f"injection_index must be {T} integers, got {index.dtype} of shape "
                         f"{index.shape}")
    if index.min() < 0 or index.max() >= K:
        raise ValueError(f"injection_index must be from 0 to {K - 1}, got {index.min()} to "
                         f"{index.max()}")
    return index.astype(np.int64, copy=False)


def check_voltages(name: str, value: np.ndarray, shape: tuple[int | None, ...]) -> np.ndarray:
    """Return an array of this shape whose entries are finite or NaN, not all of them NaN."""
    voltages = _check.array(name, value, shape, units="V", allow_nan=True)
    if np.isnan(voltages).all():
        raise ValueError(f"{name} must hold numbers, got NaN only")
    return voltages
