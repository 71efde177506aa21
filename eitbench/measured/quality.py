"""Data-quality warnings: wrong units, and electrodes that are swapped, misnumbered or dead."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from eitbench.measured.calibration import (
    CONTACT_PRIOR_MEAN,
    Calibration,
    electrode_misfits,
    electrode_sizes,
)
from eitbench.measured.measurements import Measurements
from eitbench.physics.cem import CompleteElectrodeModel

CONDUCTIVITY_RANGE = (1e-4, 10.0)
"""S/m of fluids in vessels; sea water has 5."""
GAIN_RANGE = (0.5, 2.0)
RECIPROCITY_TOLERANCE = 0.05
"""Relative change of voltages when injection and measurement are exchanged."""
MAX_MISFIT = 0.3
"""Relative misfit of the homogeneous model above which other electrode orders are tried."""
REORDER_IMPROVEMENT = 0.5
"""Factor by which another order must reduce the misfit to be reported."""
BAD_ELECTRODE_RATIO = 4.0
"""Misfit of a bad electrode relative to the median."""
SPIKE_WINDOW = 5
"""Number of uses of an injection among which a voltage is compared."""
SPIKE_SIZE, SPIKE_RATIO = 0.2, 10.0
"""A spike differs from the median of its window by this fraction of the injection's RMS voltage,
and by this multiple of the range of the other voltages."""
SPIKE_CHUNK = 1000
"""Uses of an injection that are searched for spikes at once."""
N_NAMED_SPIKES = 3


def percent(fraction: float) -> str:
    """Format a fraction with two digits, or all before the point: ``0.13 %``, ``130 %``."""
    return f"{100 * fraction:.2g} %" if fraction < 0.995 else f"{100 * fraction:.0f} %"


def find_spikes(voltages: np.ndarray, injection_index: np.ndarray) -> np.ndarray:
    """Return (T, M) bool: single ``voltages`` (T, M) that differ by far from the same channel's
    voltages in the uses of the injection before and after."""
    spikes = np.zeros(voltages.shape, dtype=bool)
    for k in np.unique(injection_index):
        uses = np.flatnonzero(injection_index == k)
        if len(uses) < SPIKE_WINDOW:
            continue
        sample = voltages[uses[::-(-len(uses) // SPIKE_CHUNK)]]
        channels = np.isfinite(sample).any(axis=0)
        size = np.sqrt(np.mean(np.nanmedian(sample[:, channels], axis=0)**2))
        starts = np.clip(np.arange(len(uses)) - SPIKE_WINDOW // 2, 0, len(uses) - SPIKE_WINDOW)
        for begin in range(0, len(uses), SPIKE_CHUNK):        # large files stay on disk
            chunk = slice(begin, begin + SPIKE_CHUNK)
            first, last = starts[chunk][0], starts[chunk][-1] + SPIKE_WINDOW
            windows = sliding_window_view(voltages[uses[first:last]], SPIKE_WINDOW,
                                          axis=0)[starts[chunk] - first]  # (uses, M, window)
            typical = np.median(windows, axis=2)               # NaN where a voltage is missing
            deviations = np.sort(np.abs(windows - typical[..., None]), axis=2)
            with np.errstate(invalid="ignore"):
                own = np.abs(voltages[uses[chunk]] - typical)
                spikes[uses[chunk]] = ((own > SPIKE_SIZE * size) & (own == deviations[..., -1])
                                       & (own > SPIKE_RATIO * deviations[..., -2]))
    return spikes


def spike_warnings(measurements: Measurements, spikes: np.ndarray) -> list[str]:
    """Return a sentence that names the first spikes."""
    found = np.argwhere(spikes)
    if not len(found):
        return []
    named = [f"frame {t // measurements.frame_length + 1}, injection "
             f"{measurements.injection_index[t] + 1}, channel {m + 1} "
             f"({measurements.voltages[t, m]:.3g} V)" for t, m in found[:N_NAMED_SPIKES]]
    more = f" and {len(found) - N_NAMED_SPIKES} more" if len(found) > N_NAMED_SPIKES else ""
    return [f"Spikes are left out, {len(found)} of {spikes.size} measurements: "
            f"{'; '.join(named)}{more}."]


def quality_warnings(measurements: Measurements, calibration: Calibration,
                     electrodes: CompleteElectrodeModel) -> list[str]:
    """Return a sentence for each contradiction between measurements, vessel and units.

    Checks conductivity and gain, reciprocity, whether another order of the electrodes fits far
    better, and electrodes whose measurements fit far worse than others. Where each channel has its
    own gain, neither reciprocity nor a misfit of all orders is reported.
    """
    return [*_unit_warnings(calibration), *_reciprocity_warnings(measurements, calibration),
            *_order_warnings(measurements, calibration, electrodes),
            *_electrode_warnings(measurements, calibration)]


def _unit_warnings(calibration: Calibration) -> list[str]:
    warnings = []
    (low, high), sigma, gain = CONDUCTIVITY_RANGE, calibration.conductivity, calibration.gain
    if not low <= sigma <= high:
        warnings.append(f"The conductivity would be {sigma:.3g} S/m, outside the usual {low:g} to "
                        f"{high:g}: currents, voltages or lengths are in other units.")
    if not GAIN_RANGE[0] <= gain <= GAIN_RANGE[1]:
        warnings.append(f"Measurements are {gain:.3g} times the values for this conductivity: they "
                        "are not in volts, or currents not in amperes.")
    return warnings


def _reciprocity_warnings(measurements: Measurements, calibration: Calibration) -> list[str]:
    currents = measurements.currents
    rows = measurements.matrix - measurements.matrix.mean(axis=1, keepdims=True)
    norms = np.outer(np.linalg.norm(currents, axis=1), np.linalg.norm(rows, axis=1))
    cosine = currents @ rows.T / np.maximum(norms, 1e-300)
    paired = cosine.max(axis=1) > 1.0 - 1e-9   # a measurement is across the injecting electrodes
    channel = cosine.argmax(axis=1)[paired]
    injected = np.abs(currents[paired]).max(axis=1, keepdims=True)
    resistance = calibration.mean_voltages[paired][:, channel] / injected
    difference = resistance - resistance.T
    finite = np.isfinite(difference)
    if not finite.any() or calibration.correction == "gain":
        return []
    scale = np.sqrt(2.0 * np.mean(resistance[finite]**2))
    change = float(np.sqrt(np.mean(difference[finite]**2)) / scale)
    if change <= RECIPROCITY_TOLERANCE:
        return []
    return [f"Exchanging injection and measurement changes voltages by {percent(change)}, which "
            "breaks reciprocity: the order of injections or of measurements is wrong, or channels "
            "have different gains (then --correction gain helps)."]


def _order_warnings(measurements: Measurements, calibration: Calibration,
                    electrodes: CompleteElectrodeModel) -> list[str]:
    """Try other orders of electrodes in the measurements, and pairs swapped in injections too."""
    L = electrodes.n_electrodes
    model = electrodes.with_contacts(CONTACT_PRIOR_MEAN * electrode_sizes(electrodes).mean())
    R = model.transfer_resistance(np.ones(model.mesh.n_nodes))
    numbers = np.arange(L)
    finite = np.isfinite(calibration.mean_voltages)

    def misfit(injecting: np.ndarray, measuring: np.ndarray) -> float:
        """Return the relative misfit of measurements without an injecting electrode."""
        currents = measurements.currents[:, injecting]
        matrix = measurements.matrix[:, measuring]
        passive = finite & (np.abs(currents) @ np.abs(matrix).T == 0.0)
        # where all electrodes inject, only channels near zero remain: their misfit is mostly noise
        used = passive if 2 * passive.sum() > finite.sum() else finite
        y, x = calibration.mean_voltages[used], (currents @ R @ matrix.T)[used]
        return float(np.linalg.norm(y - (x @ y) / (x @ x) * x) / np.linalg.norm(y))

    described = misfit(numbers, numbers)
    if described <= MAX_MISFIT:
        return []
    orders = [("Measurements seem to number electrodes in the opposite direction of injections",
               numbers, (first - numbers) % L) for first in range(L)]
    orders += [(f"Measurements seem to number electrodes with an offset of {offset} to injections",
                numbers, (numbers + offset) % L) for offset in range(1, L)]
    for a, b in combinations(range(L), 2):
        swapped = numbers.copy()
        swapped[[a, b]] = b, a
        orders.append((f"Electrodes {a + 1} and {b + 1} seem to be swapped", swapped, swapped))
    misfits = [misfit(injecting, measuring) for _, injecting, measuring in orders]
    best = int(np.argmin(misfits))
    if misfits[best] <= REORDER_IMPROVEMENT * described:
        return [f"{orders[best][0]}: this reduces the misfit of the homogeneous model from "
                f"{percent(described)} to {percent(misfits[best])}."]
    if calibration.correction == "gain":
        return []
    return [f"The homogeneous model has a misfit of {percent(described)} of the voltages: the "
            "vessel, the order of the electrodes or the units differ from the description."]


def _electrode_warnings(measurements: Measurements, calibration: Calibration) -> list[str]:
    if (np.count_nonzero(measurements.matrix, axis=1) > 2).any():
        return []
    misfit = electrode_misfits(calibration, measurements.matrix)
    misfit /= np.sqrt(np.nanmean(calibration.mean_voltages**2))
    median = float(np.median(misfit))
    return [f"Electrode {worst + 1} looks dead or loose: the misfit of its measurements is "
            f"{percent(misfit[worst])} of the RMS voltage, the median of all electrodes "
            f"{percent(median)}."
            for worst in np.flatnonzero((misfit > BAD_ELECTRODE_RATIO * median) & (misfit > 0.1))]
