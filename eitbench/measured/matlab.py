"""Readers of MATLAB files: KTC 2023, KIT4, and the sample data of EIDORS.

Räsänen et al., "Kuopio Tomography Challenge 2023 open electrical impedance tomographic dataset";
Hauptmann et al., "Open 2D electrical impedance tomography data archive" (2017).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.io import loadmat
from scipy.io.matlab import MatReadError
from scipy.sparse import issparse

from eitbench.measured.measurements import Measurements, provenance

MILLIAMPERE = 1e-3
MATLAB_TYPES = {"O": "cell array or object", "U": "character array"}
"""Kind of a dtype -> type in MATLAB."""
KTC_VARIABLES = (("Inj", "Mpat", "Uel"), ("Injref", "Mpat", "Uelref"),
                 ("CurrentPattern", "MeasPattern", "Uel"))
"""Injections, measurement patterns and voltages in files of KTC, its empty tank, and KIT4."""
KTC_REFERENCES = ("ref.mat", "datamat_1_0.mat")
"""Names of the file of the empty tank: KTC, KIT4."""
EIDORS_ELECTRODES = 16
EIDORS_REFERENCES = {"v_rotate": "v_reference", "zc_demo3": "zc_h_demo3",
                     "zc_demo4": "zc_h_demo4", "zc_resp": None}
"""Variable of frames -> variable of homogeneous fluid."""
EIDORS_FRAME_TIMES = {"zc_demo3": 1 / 7, "zc_demo4": 1 / 7, "zc_resp": 1 / 7}
"""Seconds per frame, where known (`montreal_data_1995.readme`)."""


def load_variables(path: Path, *required: str) -> dict[str, np.ndarray]:
    """Load a .mat file up to version 7; ``ValueError`` names the file and missing variables."""
    try:
        content = loadmat(path, appendmat=False)
    except (MatReadError, NotImplementedError, OSError, TypeError, ValueError, KeyError,
            IndexError) as error:
        raise ValueError(f"{path} must be a complete MATLAB file of version 7 or earlier, as "
                         f"`save -v7` writes: {error}") from None
    variables = {name: value for name, value in content.items() if not name.startswith("__")}
    if missing := [name for name in required if name not in variables]:
        raise ValueError(f"{path} must hold {', '.join(missing)}, got "
                         f"{', '.join(variables) or 'no variables'}")
    for name in required:
        value = variables[name]
        if issparse(value):
            variables[name] = value.toarray()
        elif not (np.issubdtype(value.dtype, np.number) or value.dtype == bool):
            kind = "struct" if value.dtype.names else MATLAB_TYPES.get(value.dtype.kind, "object")
            raise ValueError(f"{path}: {name} must be a numeric array, got a {kind}")
    return variables


def read_ktc(path: Path) -> Measurements:
    """Read KTC's ``data*.mat`` or KIT4's ``datamat_*.mat``, with the file of the empty tank if it
    is in the same folder.

    The files state no units. Assumed are currents in mA (KTC: about 1.5 mA at 77 kHz), voltages in
    V, with which a tank of tap water has 0.01 S/m, and one second between injections. Removed
    measurements are NaN.
    """
    currents, matrix, voltages = _ktc_arrays(path)
    empty = None
    for reference in (path.with_name(name) for name in KTC_REFERENCES if name != path.name):
        if empty is None and reference.is_file():
            *patterns, values = _ktc_arrays(reference)
            if any(a.shape != b.shape or not np.allclose(a, b)
                   for a, b in zip(patterns, (currents, matrix), strict=True)):
                raise ValueError(f"{reference} must have the injections and patterns of {path}")
            empty = values[None]
    return Measurements.from_sequence(
        MILLIAMPERE * currents, matrix, voltages, np.arange(float(len(voltages))), empty,
        provenance(path, assumed="currents in mA, voltages in V, a second between injections"))


def _ktc_arrays(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return currents (T, L) in the file's unit, matrix (M, L) and voltages (T, M)."""
    variables = load_variables(path)
    names = next((names for names in KTC_VARIABLES if names[0] in variables), KTC_VARIABLES[0])
    variables = load_variables(path, *names)
    currents, matrix, voltages = (variables[name].astype(float) for name in names)
    currents, matrix = currents.T, matrix.T
    T, M = len(currents), len(matrix)
    if voltages.size != T * M:
        raise ValueError(f"{path}: {names[2]} must hold {T}·{M} voltages, one for each of "
                         f"{names[0]} and {names[1]}, got {voltages.shape}")
    if voltages.shape == (M, T) and M != T:                 # KIT4 has one column per injection
        return currents, matrix, voltages.T
    return currents, matrix, voltages.reshape(T, M)


def read_eidors(path: Path, name: str | None = None,
                reference: str | None = None) -> Measurements:
    """Read the frames (256, F) of the variable ``name``, by default the first known one, such as
    ``v_rotate`` of iirc_data_2006.mat or ``zc_demo3`` of montreal_data_1995.mat, and homogeneous
    frames of the variable ``reference``, by default as in `EIDORS_REFERENCES`.

    Row 16·i + j of a frame is the voltage between electrodes j and j + 1 while 1 mA (assumed)
    enters at i and leaves at i + 1, in units of the instrument. The real part of complex values is
    used. Files differ in sign; the sign of passive fluid is used. Measurements with an injecting
    electrode are NaN.
    """
    variables = load_variables(path)
    if name is None:
        name = next((each for each in EIDORS_REFERENCES if each in variables), None)
        if name is None:
            raise ValueError(f"name must be the variable of the frames, such as --option "
                             f"name=VARIABLE, one of {', '.join(variables) or 'no variables'}")
    reference = reference or EIDORS_REFERENCES.get(name)
    variables = load_variables(path, name, *filter(None, [reference]))
    frames = _eidors_frames(path, name, variables[name])
    L, F = EIDORS_ELECTRODES, len(frames)
    pairs = np.eye(L) - np.roll(np.eye(L), 1, axis=1)
    part = ", real part" if np.iscomplexobj(variables[name]) else ""
    timed = "" if name in EIDORS_FRAME_TIMES else ", a second per frame"
    return Measurements(
        MILLIAMPERE * pairs, np.tile(np.arange(L), F), pairs, frames.reshape(-1, L),
        EIDORS_FRAME_TIMES.get(name, 1.0) / L * np.arange(F * L),
        _eidors_frames(path, reference, variables[reference]) if reference else None,
        provenance(path, variable=name,
                   assumed=f"1 mA, voltages in units of the instrument{part}{timed}"))


def _eidors_frames(path: Path, name: str, values: np.ndarray) -> np.ndarray:
    """Return (F, 16, 16) with the sign of passive fluid, NaN where an electrode injects."""
    L = EIDORS_ELECTRODES
    if values.ndim != 2 or values.shape[0] != L * L:
        raise ValueError(f"{path}: {name} must have {L * L} rows, got shape {values.shape}")
    frames = values.real.astype(float).T.reshape(-1, L, L)
    distance = np.abs(np.subtract.outer(np.arange(L), np.arange(L)))
    frames[:, (distance <= 1) | (distance == L - 1)] = np.nan
    return -np.abs(frames)
