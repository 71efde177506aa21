"""Sciospec's ``.eit`` files: a folder of frames, each with a header, injections and complex
potentials."""

from __future__ import annotations

import hashlib
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

from eitbench.data.measured.measurements import Measurements

AMPLITUDE, FREQUENCY, TIME, CHANNELS = 8, 4, 3, "MeasurementChannels:"
"""Lines of the header, the first being 0: peak current in A, Hz, and when the frame was taken."""
WHEN = "%Y.%m.%d. %H:%M:%S.%f"


class _Frame(NamedTuple):
    time: float
    """s"""
    frequency: float
    """Hz"""
    amplitude: float
    """A"""
    pairs: list[tuple[int, int]]
    potentials: np.ndarray
    """(K, L) complex, V"""


def read(path: Path | str, reference_frames: int = 0) -> Measurements:
    """All ``.eit`` files of a folder, in the order of their names, or one file.

    Potentials are to the instrument's ground; real parts are used, against their mean. The current
    enters at the first electrode of a pair with the header's amplitude, in A. The first
    ``reference_frames`` are homogeneous fluid, and no part of the record. A frame's injections are
    taken to come evenly until the next frame. ``ValueError`` naming the file and what is wrong.
    """
    path = Path(path)
    files = sorted(path.glob("*.eit")) if path.is_dir() else [path]
    if not files:
        raise ValueError(f"{path} must hold .eit files, there are none")
    frames = [_read(file) for file in files]
    first = frames[0]
    for file, frame in zip(files, frames, strict=True):
        if frame.pairs != first.pairs or frame.amplitude != first.amplitude:
            raise ValueError(f"{file} must have the injections of {files[0]}")
    K, L = first.potentials.shape
    currents = np.zeros((K, L))
    for row, (enters, leaves) in zip(currents, first.pairs, strict=True):
        row[[enters - 1, leaves - 1]] = first.amplitude, -first.amplitude
    readings = np.array([frame.potentials.real for frame in frames])
    readings -= readings.mean(axis=2, keepdims=True)
    F = len(frames) - reference_frames
    if not 0 <= reference_frames < len(frames):
        raise ValueError(f"reference_frames must be from 0 to {len(frames) - 1}, got "
                         f"{reference_frames}")
    begins = np.array([frame.time for frame in frames])
    lasts = float(np.median(np.diff(begins))) if len(frames) > 1 else 1.0
    times = begins[reference_frames:, None] - begins[0] + lasts / K * np.arange(K)
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
    # every record's folder is called setup; the one around it tells them apart
    name = f"{path.resolve().parent.name}/{path.name}" if path.is_dir() else path.name
    return Measurements(
        currents, np.tile(np.arange(K), F), np.eye(L), readings[reference_frames:].reshape(-1, L),
        times.ravel(), readings[:reference_frames] if reference_frames else None,
        {"file": name, "sha256": digest, "frames": F, "frequency": first.frequency,
         "assumed": "real parts, against the mean of all electrodes; amplitude in A"})


def _read(path: Path) -> _Frame:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        header = int(lines[0])
        time = datetime.strptime(lines[TIME].strip(), WHEN).timestamp()
        frequency, amplitude = float(lines[FREQUENCY]), float(lines[AMPLITUDE])
        channels = next(line for line in lines[:header] if line.startswith(CHANNELS))
        count = len(channels.removeprefix(CHANNELS).split(","))
    except (OSError, UnicodeDecodeError, ValueError, IndexError, StopIteration):
        raise ValueError(f"{path} must begin with the header of a .eit file") from None
    pairs, potentials = [], []
    body = lines[header:]
    for number in range(0, len(body) - len(body) % 2, 2):
        try:
            enters, leaves = (int(each) for each in body[number].split())
            parts = np.array(body[number + 1].split(), dtype=float)
        except ValueError:
            raise ValueError(f"{path}: line {header + number + 1} must be two electrodes, and the "
                             "next one numbers with decimal points") from None
        if len(parts) < 2 * count or len(parts) % 2:
            raise ValueError(f"{path}: line {header + number + 2} must have {2 * count} numbers, "
                             f"two for each of {count} channels, got {len(parts)}")
        if not 1 <= min(enters, leaves) <= max(enters, leaves) <= count:
            raise ValueError(f"{path}: line {header + number + 1} must name electrodes from 1 to "
                             f"{count}, got {body[number]!r}")
        pairs.append((enters, leaves))
        potentials.append(parts[:2 * count:2] + 1j * parts[1:2 * count:2])
    if not pairs or len(body) % 2:
        raise ValueError(f"{path} must hold pairs of lines after its header, injection and "
                         f"potentials, got {len(body)} lines")
    return _Frame(time, frequency, amplitude, pairs, np.array(potentials))
