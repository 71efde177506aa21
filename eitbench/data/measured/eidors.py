"""EIDORS' sample data of 16 electrodes, adjacent injections and readings: 256 numbers a frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from eitbench.data.measured.matlab import needed, provenance, variables
from eitbench.data.measured.measurements import Measurements

L = 16
MILLIAMPERE = 1e-3
REFERENCES = {"v_rotate": "v_reference", "zc_demo3": "zc_h_demo3", "zc_demo4": "zc_h_demo4",
              "zc_resp": None}
"""Variables that hold frames, and what holds homogeneous fluid."""
FRAME_TIME = {"zc_demo3": 1 / 7, "zc_demo4": 1 / 7, "zc_resp": 1 / 7}
"""s a frame, where it is known (`montreal_data_1995.readme`)."""


def read(path: Path | str, name: str | None = None, reference: str | None = None) -> Measurements:
    """The frames (256, F) of the variable ``name``, by default the first that is known, such as
    ``v_rotate`` of iirc_data_2006.mat or ``zc_demo3`` of montreal_data_1995.mat.

    Number 16·i + j of a frame is the voltage between electrodes j and j + 1 while 1 mA, as is
    assumed, enters at i and leaves at i + 1. Voltages are in units of the instrument; real parts
    are used of complex ones. As the sign is not always recorded, all readings have that of a
    resistive body, which is negative off the injecting pair. Readings with an electrode that
    injects are NaN. ``ValueError`` naming the file and what is wrong with it.
    """
    path = Path(path)
    found = variables(path)
    if name is None:
        name = next((each for each in REFERENCES if each in found), next(iter(REFERENCES)))
    (frames,) = needed(found, path, name)
    reference = reference or REFERENCES.get(name)
    empty = _frames(path, reference, needed(found, path, reference)[0]) if reference else None
    readings = _frames(path, name, frames)
    F = len(readings)
    step = FRAME_TIME.get(name, 1.0) / L
    currents = MILLIAMPERE * (np.eye(L) - np.roll(np.eye(L), 1, axis=1))
    matrix = np.eye(L) - np.roll(np.eye(L), 1, axis=1)
    part = ", real part" if np.iscomplexobj(frames) else ""
    timed = "" if name in FRAME_TIME else ", a second a frame"
    return Measurements(
        currents, np.tile(np.arange(L), F), matrix, readings.reshape(-1, L),
        step * np.arange(F * L), empty,
        provenance(path, variable=name,
                   assumed=f"1 mA, readings in units of the instrument{part}{timed}"))


def _frames(path: Path, name: str, given: np.ndarray) -> np.ndarray:
    """(F, 16, 16) with the sign of a resistive body, NaN where an electrode injects."""
    if given.ndim != 2 or given.shape[0] != L * L:
        raise ValueError(f"{path}: {name} must have {L * L} rows, got shape {given.shape}")
    values = given.real.astype(float).T.reshape(-1, L, L)
    apart = np.abs(np.subtract.outer(np.arange(L), np.arange(L)))
    values[:, (apart <= 1) | (apart == L - 1)] = np.nan
    return -np.abs(values)
