"""`Measurements`: what an instrument injected and read, with units, in one documented file."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
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
PARTS = ("currents", "injections", "matrix", "readings", "times")
"""Data sets of a file; a reference may come to them."""
IN_MEMORY = 1 << 26
"""bytes of readings"""
BLOCK = 1 << 20
"""numbers that are looked at at once"""
BALANCE = 1e-6
"""Part of an injection's largest current that its currents may fail to sum to zero by."""


@dataclass(frozen=True, eq=False)
class Measurements:
    """A record of T readings, M numbers each, of K different injections by L electrodes.

    Arrays are copied, but for those that are read-only, such as the readings of a large file, which
    stay on the disk (`load`). ``ValueError`` naming the field that is of the wrong shape, holds no
    numbers, or contradicts another; currents that fail to sum to zero by rounding are freed of
    their mean.
    """

    currents: np.ndarray
    """(K, L) into each electrode in A, each injection once; rows sum to zero"""
    injections: np.ndarray
    """(T,) int, which of them was on"""
    matrix: np.ndarray
    """(M, L) from potentials, against the mean of all electrodes, to readings"""
    readings: np.ndarray
    """(T, M) V, NaN where nothing was read"""
    times: np.ndarray
    """(T,) s, increasing"""
    reference: np.ndarray | None = None
    """(F, K, M) V, F records of homogeneous fluid by injection; NaN where nothing was read"""
    source: Mapping[str, Any] = field(default_factory=dict)
    """where it comes from, in words and numbers: file, instrument, licence, frequency, and what was
    assumed about units"""

    def __post_init__(self) -> None:
        currents = _check.array("currents", self.currents, (None, None), units="A")
        K, L = currents.shape
        surplus = np.abs(currents.sum(axis=1))
        largest = np.abs(currents).max(axis=1)
        if not largest.all():
            raise ValueError(f"currents must flow, got none in injection {int(largest.argmin())}")
        if (wrong := np.flatnonzero(surplus > BALANCE * largest)).size:
            k = int(wrong[0])
            raise ValueError("currents must sum to zero over the electrodes, got "
                             f"{currents[k].sum():g} A in injection {k}")
        on = currents != 0.0
        currents = currents - on * (currents.sum(axis=1) / on.sum(axis=1))[:, None]
        if len(np.unique(currents, axis=0)) < K:
            raise ValueError(f"currents must be {K} different injections, got some twice; see "
                             "Measurements.of_sequence")
        matrix = _check.array("matrix", self.matrix, (None, L))
        M = len(matrix)
        readings = _numbers("readings", self.readings, (None, M))
        T = len(readings)
        injections = _injections(self.injections, T, K)
        times = _check.array("times", self.times, (T,), units="s")
        _increase(times)
        reference = None
        if self.reference is not None:
            reference = _numbers("reference", self.reference, (None, K, M))
        json.dumps(dict(self.source), allow_nan=False)
        for name, value in (("currents", currents), ("injections", injections),
                            ("matrix", matrix), ("readings", readings), ("times", times),
                            ("reference", reference)):
            if value is not None and value.flags.writeable:
                value = value.copy()
                value.setflags(write=False)
            object.__setattr__(self, name, value)

    @classmethod
    def of_sequence(cls, currents: np.ndarray, matrix: np.ndarray, readings: np.ndarray,
                    times: np.ndarray, reference: np.ndarray | None = None,
                    source: Mapping[str, Any] | None = None) -> Measurements:
        """From ``currents`` (T, L), one row a reading, and a ``reference`` (F, T, M) in the same
        order: equal injections become one."""
        currents = _check.array("currents", currents, (None, None), units="A")
        different, first, which = np.unique(currents, axis=0, return_index=True,
                                            return_inverse=True)
        order = np.argsort(first)                              # as they came
        rank = np.argsort(order)
        injections = rank[which.reshape(-1)]
        by_injection = None
        if reference is not None:
            reference = np.asarray(reference, dtype=float)
            if reference.ndim != 3 or reference.shape[1] != len(currents):
                raise ValueError(f"reference must have shape (F, {len(currents)}, M), got "
                                 f"{reference.shape}")
            by_injection = _by_injection(reference, injections, len(different))
        return cls(different[order], injections, matrix, readings, times, by_injection,
                   source or {})

    @cached_property
    def frame(self) -> int:
        """Readings until each injection has come once."""
        first = np.full(len(self.currents), -1)
        for begin in range(0, len(self.injections), BLOCK):
            block = self.injections[begin:begin + BLOCK]
            came, where = np.unique(block, return_index=True)
            new = first[came] < 0
            first[came[new]] = begin + where[new]
            if (first >= 0).all():
                break
        return 1 + int(first.max())

    @cached_property
    def driven(self) -> np.ndarray:
        """(T, M) bool: readings in which an electrode takes part that carries current."""
        carries = self.currents != 0.0
        return (carries.astype(float) @ (self.matrix != 0.0).T.astype(float) > 0.0)[self.injections]

    def homogeneous(self, frames: int = 1) -> np.ndarray:
        """(F, K, M) V: the reference, or where there is none the first ``frames`` frames."""
        if self.reference is not None:
            return self.reference
        steps = min(_check.integer("frames", frames, low=1) * self.frame, len(self.readings))
        return _by_injection(self.readings[None, :steps], self.injections[:steps],
                             len(self.currents))

    @cached_property
    def largest(self) -> float:
        """V, of all readings."""
        return max(float(np.abs(block[np.isfinite(block)]).max(initial=0.0))
                   for block in _blocks(self.readings))

    def part(self, steps: slice) -> Measurements:
        """The record of some readings one after another, of those injections that came."""
        injections = self.injections[steps]
        if not injections.size:
            raise ValueError(f"steps must hold readings of the {len(self.injections)}, got {steps}")
        came = np.unique(injections)
        reference = None if self.reference is None else self.reference[:, came]
        return Measurements(self.currents[came], np.searchsorted(came, injections), self.matrix,
                            self.readings[steps], self.times[steps], reference, self.source)

    def frames(self, most: int | None = None) -> np.ndarray:
        """(F, K, M) V: whole frames one after another, the first so many of them; NaN where nothing
        was read."""
        whole = len(self.readings) - len(self.readings) % self.frame
        if most is not None:
            whole = min(whole, most * self.frame)
        return np.concatenate([
            _by_injection(self.readings[None, t:t + self.frame],
                          self.injections[t:t + self.frame], len(self.currents))
            for t in range(0, max(whole, 1), self.frame)])

    def save(self, path: Path | str) -> Path:
        """Write one HDF5 file, whole or not at all; extra ``export``."""
        with needed_by("a file of measurements"):
            import h5py
        path = Path(path)
        with replacing(path) as temporary, h5py.File(temporary, "w") as file:
            file.attrs["format"] = FORMAT
            file.attrs["version"] = VERSION
            file.attrs["source"] = json.dumps(dict(self.source))
            for name in (*PARTS, "reference"):
                value = getattr(self, name)
                if value is not None:
                    file.create_dataset(name, data=value)
        return path

    @classmethod
    def load(cls, path: Path | str, steps: slice = slice(None)) -> Measurements:
        """What `save` has written, or only some of its readings, of which alone is read then.

        What takes more than `IN_MEMORY` bytes stays in the file, which must not change, and is
        read from there where it is needed. ``ValueError`` naming the file and what is wrong
        with it.
        """
        with needed_by("a file of measurements"):
            import h5py
        path = Path(path)
        try:
            with h5py.File(path, "r") as file:
                if file.attrs.get("format") != FORMAT or file.attrs.get("version") != VERSION:
                    raise ValueError(f"format must be {FORMAT!r}, version {VERSION}, got "
                                     f"{file.attrs.get('format')!r}, version "
                                     f"{file.attrs.get('version')!r}")
                if missing := [name for name in PARTS if name not in file]:
                    raise ValueError(f"there is no {', '.join(missing)} in it")
                along = {name: _mapped(path, file[name], steps)
                         for name in ("injections", "times", "readings")}
                if not along["injections"].size:
                    raise ValueError("steps must hold some of its "
                                     f"{len(file['injections'])} readings, got {steps}")
                whole = {name: file[name][()] for name in ("currents", "matrix")}
                reference = file["reference"][()] if "reference" in file else None
                source = json.loads(file.attrs["source"])
            return cls(**along, **whole, reference=reference, source=source)
        except (OSError, KeyError, ValueError, TypeError) as error:
            raise ValueError(f"{path} must be a file of measurements: {error}") from None


def _mapped(path: Path, dataset: Any, steps: slice) -> np.ndarray:
    """Some rows of a data set, in the file where they are large and lie there as they are."""
    large = dataset.size * dataset.dtype.itemsize > IN_MEMORY
    begin = dataset.id.get_offset()                 # None if it is compressed or in chunks
    if not large or begin is None or dataset.dtype not in (np.float64, np.int64):
        rows: np.ndarray = dataset[steps]
        rows.setflags(write=False)                              # long ones are not copied
        return rows
    return np.memmap(path, dataset.dtype, "r", begin, dataset.shape)[steps]


def _blocks(values: np.ndarray) -> Iterator[np.ndarray]:
    """Of rows, so many at once that they take little memory."""
    rows = max(BLOCK // max(values[0].size, 1), 1)
    for begin in range(0, len(values), rows):
        yield values[begin:begin + rows]


def _by_injection(records: np.ndarray, injections: np.ndarray, K: int) -> np.ndarray:
    """(F′, K, M) from F records (F, T, M): an injection's readings one after another, NaN where
    another has more."""
    F, T, M = records.shape
    turn = np.zeros(T, dtype=int)
    count = np.zeros(K, dtype=int)
    for t, k in enumerate(injections):
        turn[t] = count[k]
        count[k] += 1
    most = int(count.max())
    found = np.full((F, most, K, M), np.nan)
    found[:, turn, injections] = records
    return found.reshape(F * most, K, M)


def _increase(times: np.ndarray) -> None:
    """``ValueError`` if they do not."""
    for begin in range(0, len(times), BLOCK):
        block = times[begin:begin + BLOCK + 1]
        if (back := np.flatnonzero(np.diff(block) <= 0)).size:
            t = begin + int(back[0])
            raise ValueError(f"times must increase, got {times[t]:g} s and then "
                             f"{times[t + 1]:g} s at reading {t + 1}")


def _injections(given: np.ndarray, T: int, K: int) -> np.ndarray:
    injections = np.asarray(given)
    if injections.shape != (T,) or not np.issubdtype(injections.dtype, np.integer):
        raise ValueError(f"injections must be {T} integers, one a reading, got "
                         f"{injections.dtype} of shape {injections.shape}")
    if injections.min() < 0 or injections.max() >= K:
        raise ValueError(f"injections must be numbers from 0 to {K - 1}, got "
                         f"{injections.min()} to {injections.max()}")
    return injections.astype(np.int64, copy=False)


def _numbers(name: str, given: np.ndarray, shape: tuple[int | None, ...]) -> np.ndarray:
    """Numbers of this shape, some of which may be NaN."""
    value = np.asarray(given)
    if np.iscomplexobj(value):
        raise ValueError(f"{name} must be real, got complex ones; say which part is used")
    try:
        value = value.astype(float, copy=False)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must hold numbers, got {value.dtype}") from None
    fits = value.ndim == len(shape) and all(
        want in (None, size) for want, size in zip(shape, value.shape, strict=True))
    if not fits or not value.size:
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        raise ValueError(f"{name} must have shape ({wanted}), got {value.shape}")
    if any(np.isinf(block).any() for block in _blocks(value)):
        raise ValueError(f"{name} must be finite or NaN, got infinite ones")
    if all(np.isnan(block).all() for block in _blocks(value)):
        raise ValueError(f"{name} must hold numbers, got NaN only")
    return value
