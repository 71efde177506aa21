"""KTC 2023 and KIT4: one frame of a tank with 32 or 16 electrodes, and one without any target.

Räsänen et al., "Kuopio Tomography Challenge 2023 open electrical impedance tomographic dataset";
Hauptmann et al., "Open 2D electrical impedance tomography data archive" (2017).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from eitbench.data.measured.matlab import needed, provenance, variables
from eitbench.data.measured.measurements import Measurements

MILLIAMPERES = 1e-3
REFERENCES = ("ref.mat", "datamat_1_0.mat")
"""Files beside a record that hold the empty tank: of KTC, and of KIT4."""
NAMES = (("Inj", "Mpat", "Uel"), ("Injref", "Mpat", "Uelref"),
         ("CurrentPattern", "MeasPattern", "Uel"))
"""Injections, measurement patterns and readings: KTC, its reference, KIT4."""


def read(path: Path | str, reference: Path | str | None = None) -> Measurements:
    """One of KTC's ``data*.mat``, or KIT4's ``datamat_*.mat``, with the file of the empty tank,
    which is looked for beside it by default.

    Currents are taken for mA (KTC: about 1.5 mA at 77 kHz) and readings for V, since neither is
    stated: with these a tank of tap water has 0.01 S/m. Readings that were dropped are NaN. The
    injections came one after another; a second apart is made up. ``ValueError`` naming the file and
    what is wrong with it.
    """
    path = Path(path)
    currents, matrix, readings = _content(path)
    if reference is None:
        beside = [path.with_name(name) for name in REFERENCES]
        reference = next((each for each in beside if each.is_file() and each != path), None)
    empty = None
    if reference is not None:
        other, others, empty = _content(Path(reference))
        same = other.shape == currents.shape and np.allclose(other, currents)
        if not same or others.shape != matrix.shape or not np.array_equal(others, matrix):
            raise ValueError(f"{reference} must have the injections and patterns of {path}")
    return Measurements.of_sequence(
        MILLIAMPERES * currents, matrix, readings, np.arange(float(len(readings))),
        None if empty is None else empty[None],
        provenance(path, assumed="currents in mA, readings in V, a second between injections"))


def _content(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Currents (T, L) in the file's unit, matrix (M, L), readings (T, M)."""
    found = variables(path)
    names = next((names for names in NAMES if names[0] in found), NAMES[0])
    injections, patterns, readings = needed(found, path, *names)
    currents = injections.T.astype(float)
    matrix = patterns.T.astype(float)
    T, M = len(currents), len(matrix)
    if readings.size != T * M:
        raise ValueError(f"{path}: {names[2]} must hold {T}·{M} readings, one for each of "
                         f"{names[0]} and {names[1]}, got {readings.shape}")
    if readings.shape == (M, T) and M != T:                 # KIT4 has a column an injection
        return currents, matrix, readings.T.astype(float)
    return currents, matrix, readings.astype(float).reshape(T, M, order="C")
