"""What is odd about a record: wrong units, electrodes that are swapped, turned round or dead."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from eitbench.estimation.measured.calibration import CONTACT_LEVEL, lengths

if TYPE_CHECKING:
    from eitbench.data.measured import Measurements
    from eitbench.estimation.measured.calibration import Calibration
    from eitbench.physics.cem import CompleteElectrodeModel

CONDUCTS = (1e-4, 10.0)
"""S/m between which fluids in vessels conduct; sea water has 5."""
GAIN = (0.5, 2.0)
"""Between which an instrument that reads volts and amperes is off."""
RECIPROCAL = 0.05
"""Part of the readings by which exchanging injection and reading may change them."""
EXPLAINED = 0.3
"""Part of the readings that the model of homogeneous fluid may miss, …"""
BETTER = 0.5
"""… and to which another order of the electrodes must bring what it misses, to be named."""
BAD = 4.0
"""An electrode's readings miss so many times more than those of most others."""


def doubts(record: Measurements, calibration: Calibration,
           electrodes: CompleteElectrodeModel) -> list[str]:
    """Sentences about what does not look like readings in volts of fluid in this vessel; empty if
    nothing is odd.

    Checks the conductivity or gain that was calibrated, reciprocity (exchanging injection and
    reading leaves a reading as it is), whether another order of the electrodes fits far better,
    and electrodes whose readings fit far worse than all others'. Where channels are corrected by a
    gain each, reciprocity and a bad fit in every order are not odd.

    Parameters
    ----------
    record : Measurements
    calibration : Calibration
        Of the record.
    electrodes : CompleteElectrodeModel
        Of the vessel.
    """
    return [*_of_units(record, calibration), *_of_reciprocity(record, calibration),
            *_of_order(record, calibration, electrodes), *_of_electrodes(record, calibration)]


def _of_units(record: Measurements, calibration: Calibration) -> list[str]:
    said = []
    low, high = CONDUCTS
    if not low <= calibration.conductivity <= high:
        said.append(f"The fluid would conduct {calibration.conductivity:.3g} S/m, where {low:g} to "
                    f"{high:g} are usual: currents, readings or lengths are in other units.")
    low, high = GAIN
    if not low <= calibration.gain <= high:
        said.append(f"Readings are {calibration.gain:.3g} times what the conductivity makes them: "
                    "they are not in volts, or currents not in amperes.")
    return said


def _of_reciprocity(record: Measurements, calibration: Calibration) -> list[str]:
    reads = _which_reads(record)
    injected = np.abs(record.currents).max(axis=1)
    there = reads >= 0
    values = calibration.measured[:, reads[there]]                     # (K, what reads K′)
    exchanged = values[there] / injected[there][:, None]
    off = exchanged - exchanged.T
    known = np.isfinite(off)
    if not known.any():
        return []
    size = np.sqrt(np.mean(exchanged[known]**2))
    part = float(np.sqrt(np.mean(off[known]**2)) / (np.sqrt(2) * size))
    if part <= RECIPROCAL or calibration.correction == "gain":
        return []
    return [f"Exchanging injection and reading changes readings by {100 * part:.2g} %, where it "
            "should leave them as they are: the order of injections or of readings is wrong, or "
            "channels are amplified differently (then --correction gain helps)."]


def _which_reads(record: Measurements) -> np.ndarray:
    """(K,) the reading across each injection's electrodes, as it is injected; -1 if none is."""
    found = np.full(len(record.currents), -1)
    rows = record.matrix - record.matrix.mean(axis=1, keepdims=True)
    lengths = np.linalg.norm(rows, axis=1)
    for k, current in enumerate(record.currents):
        alike = rows @ current / np.maximum(lengths * np.linalg.norm(current), 1e-300)
        m = int(alike.argmax())
        if alike[m] > 1.0 - 1e-9:
            found[k] = m
    return found


def _of_order(record: Measurements, calibration: Calibration,
              electrodes: CompleteElectrodeModel) -> list[str]:
    """Orders of the electrodes that readings are numbered by, while injections keep theirs; and of
    both, two swapped."""
    L = record.currents.shape[1]
    usual = electrodes.with_contacts(CONTACT_LEVEL * lengths(electrodes).mean())
    R = usual.transfer_resistance(np.ones(usual.mesh.n_nodes))
    numbers = np.arange(L)

    def missed(injects: np.ndarray, reads: np.ndarray) -> float:
        """Part of the readings off the injecting electrodes that this order misses."""
        currents, matrix = record.currents[:, injects], record.matrix[:, reads]
        driven = np.abs(currents) @ np.abs(matrix).T > 0.0
        there = np.isfinite(calibration.measured)
        if (there & ~driven).any():
            there &= ~driven
        y, x = calibration.measured[there], (currents @ R @ matrix.T)[there]
        return float(np.linalg.norm(y - (x @ y) / (x @ x) * x) / np.linalg.norm(y))

    described = missed(numbers, numbers)
    if described <= EXPLAINED:
        return []
    orders = [("Readings count electrodes the other way round than injections", numbers,
               (first - numbers) % L) for first in range(L)]
    orders += [(f"Readings count electrodes from {turn} further than injections", numbers,
                (numbers + turn) % L) for turn in range(1, L)]
    for a, b in combinations(range(L), 2):
        swapped = numbers.copy()
        swapped[[a, b]] = b, a
        orders.append((f"Electrodes {a + 1} and {b + 1} are swapped", swapped, swapped))
    fits = [missed(injects, reads) for _, injects, reads in orders]
    best = int(np.argmin(fits))
    if fits[best] > BETTER * described:
        if calibration.correction == "gain":
            return []
        return [f"The model of homogeneous fluid misses {100 * described:.2g} % of the readings: "
                "the vessel, the electrodes' order or the units are not as described."]
    return [f"{orders[best][0]}, it seems: so the model of homogeneous fluid misses "
            f"{100 * fits[best]:.2g} % of the readings, as described {100 * described:.2g} %."]


def _of_electrodes(record: Measurements, calibration: Calibration) -> list[str]:
    off = np.nan_to_num(calibration.measured - calibration.computed)**2
    there = np.isfinite(calibration.measured).astype(float)
    size = np.sqrt(np.nanmean(calibration.measured**2))
    by_reading = (record.matrix != 0).astype(float)
    if (by_reading.sum(axis=1) > 2).any():
        return []
    many = np.maximum((there @ by_reading).sum(axis=0), 1.0)
    missed = np.sqrt((off @ by_reading).sum(axis=0) / many) / size
    usual = float(np.median(missed))
    return [f"Electrode {worst + 1} looks dead or loose: its readings miss "
            f"{100 * missed[worst]:.2g} % of a mean reading, those of most others "
            f"{100 * usual:.2g} %."
            for worst in np.flatnonzero((missed > BAD * usual) & (missed > 0.1))]
