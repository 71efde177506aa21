"""Readers of MATLAB files: KTC 2023, KIT4, and the sample data of EIDORS.

Räsänen et al., "Kuopio Tomography Challenge 2023 open electrical impedance tomographic dataset";
Hauptmann et al., "Open 2D electrical impedance tomography data archive" (2017).
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from eitbench.measured.measurements import Measurements

MILLIAMPERE = 1e-3
KTC_VARIABLES = (("Inj", "Mpat", "Uel"), ("Injref", "Mpat", "Uelref"),
                 ("CurrentPattern", "MeasPattern", "Uel"))
"""Injections, measurement patterns and readings in files of KTC, its empty tank, and KIT4."""
KTC_REFERENCES = ("ref.mat", "datamat_1_0.mat")
"""Names of the file of the empty tank: KTC, KIT4."""
EIDORS_ELECTRODES = 16
EIDORS_REFERENCES = {"v_rotate": "v_reference", "zc_demo3": "zc_h_demo3",
                     "zc_demo4": "zc_h_demo4", "zc_resp": None}
"""Variable of frames -> variable of homogeneous fluid."""
EIDORS_FRAME_TIMES = {"zc_demo3": 1 / 7, "zc_demo4": 1 / 7, "zc_resp": 1 / 7}
"""Seconds per frame, where known (`montreal_data_1995.readme`)."""


def load_variables(path: Path, *required: str) -> dict[str, np.ndarray]:
    """Load the variables of a .mat file up to version 7; ``ValueError`` names the file, and
    ``required`` variables that are missing."""
    try:
        found = loadmat(path, appendmat=False)
    except (MatReadError, NotImplementedError, OSError, TypeError, ValueError, KeyError,
            IndexError) as error:
        raise ValueError(f"{path} must be a complete MATLAB file of version 7 or earlier, as "
                         f"`save -v7` writes: {error}") from None
    found = {name: value for name, value in found.items() if not name.startswith("__")}
    if missing := [name for name in required if name not in found]:
        raise ValueError(f"{path} must hold {', '.join(missing)}; there are "
                         f"{', '.join(found) or 'no variables'}")
    return found


def provenance(path: Path, **more: Any) -> dict[str, Any]:
    """Return the file's name and sha256, and ``more``."""
    return {"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest(), **more}


def read_ktc(path: Path) -> Measurements:
    """Read KTC's ``data*.mat`` or KIT4's ``datamat_*.mat``, with the file of the empty tank if it
    is in the same folder.

    The files state no units: currents are taken as mA (KTC: about 1.5 mA at 77 kHz) and readings
    as V, with which a tank of tap water has 0.01 S/m, and a second passes between injections.
    Removed readings are NaN.
    """
    currents, matrix, readings = _ktc_arrays(path)
    empty = None
    for reference in (path.with_name(name) for name in KTC_REFERENCES if name != path.name):
        if empty is None and reference.is_file():
            *patterns, values = _ktc_arrays(reference)
            if any(one.shape != other.shape or not np.allclose(one, other)
                   for one, other in zip(patterns, (currents, matrix), strict=True)):
                raise ValueError(f"{reference} must have the injections and patterns of {path}")
            empty = values[None]
    return Measurements.from_sequence(
        MILLIAMPERE * currents, matrix, readings, np.arange(float(len(readings))), empty,
        provenance(path, assumed="currents in mA, readings in V, a second between injections"))


def _ktc_arrays(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Currents (T, L) in the file's unit, matrix (M, L), readings (T, M)."""
    found = load_variables(path)
    names = next((names for names in KTC_VARIABLES if names[0] in found), KTC_VARIABLES[0])
    found = load_variables(path, *names)
    currents, matrix, readings = (found[name].astype(float) for name in names)
    currents, matrix = currents.T, matrix.T
    T, M = len(currents), len(matrix)
    if readings.size != T * M:
        raise ValueError(f"{path}: {names[2]} must hold {T}·{M} readings, one for each of "
                         f"{names[0]} and {names[1]}, got {readings.shape}")
    if readings.shape == (M, T) and M != T:                 # KIT4 has one column per injection
        return currents, matrix, readings.T
    return currents, matrix, readings.reshape(T, M)


def read_eidors(path: Path, name: str | None = None) -> Measurements:
    """Read the frames (256, F) of the variable ``name``, by default the first known one, such as
    ``v_rotate`` of iirc_data_2006.mat or ``zc_demo3`` of montreal_data_1995.mat.

    Row 16·i + j of a frame is the voltage between electrodes j and j + 1 while 1 mA (assumed)
    enters at i and leaves at i + 1, in units of the instrument; complex readings lose their
    imaginary part. Files differ in their sign, so all readings get that of a resistive body.
    Readings with an injecting electrode are NaN.
    """
    found = load_variables(path)
    if name is None:
        name = next((each for each in EIDORS_REFERENCES if each in found), "v_rotate")
    reference = EIDORS_REFERENCES.get(name)
    found = load_variables(path, name, *filter(None, [reference]))
    readings = _eidors_frames(path, name, found[name])
    L, F = EIDORS_ELECTRODES, len(readings)
    pairs = np.eye(L) - np.roll(np.eye(L), 1, axis=1)
    part = ", real part" if np.iscomplexobj(found[name]) else ""
    timed = "" if name in EIDORS_FRAME_TIMES else ", a second per frame"
    return Measurements(
        MILLIAMPERE * pairs, np.tile(np.arange(L), F), pairs, readings.reshape(-1, L),
        EIDORS_FRAME_TIMES.get(name, 1.0) / L * np.arange(F * L),
        _eidors_frames(path, reference, found[reference]) if reference else None,
        provenance(path, variable=name,
                   assumed=f"1 mA, readings in units of the instrument{part}{timed}"))


def _eidors_frames(path: Path, name: str, values: np.ndarray) -> np.ndarray:
    """(F, 16, 16) with the sign of a resistive body, NaN where an electrode injects."""
    L = EIDORS_ELECTRODES
    if values.ndim != 2 or values.shape[0] != L * L:
        raise ValueError(f"{path}: {name} must have {L * L} rows, got shape {values.shape}")
    frames = values.real.astype(float).T.reshape(-1, L, L)
    distance = np.abs(np.subtract.outer(np.arange(L), np.arange(L)))
    frames[:, (distance <= 1) | (distance == L - 1)] = np.nan
    return -np.abs(frames)
