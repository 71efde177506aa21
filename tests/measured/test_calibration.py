"""Calibration on homogeneous fluid: conductivity, contact impedances, noise; data-quality warnings."""

import numpy as np
import pytest
from eitbench.measured import Measurements
from eitbench.measured.calibration import calibrate, noise_from_frames
from eitbench.measured.quality import quality_warnings
from eitbench.measured.vessel import read_vessel
from tanks import CONTACTS, SIGMA, VESSEL, homogeneous, instrument

CURRENTS, MATRIX = instrument()
ELECTRODES = read_vessel(VESSEL).electrode_model(1e-4)
COARSE = read_vessel(VESSEL).shape.electrode_model(fine=False)


def calibrate_tank(voltages, **options):
    return calibrate(ELECTRODES, CURRENTS, MATRIX, voltages, **options)


@pytest.mark.parametrize(("gain", "conductivity"), [(1.0, None), (1e3, SIGMA)])
def test_parameters_are_recovered_from_exact_voltages(gain, conductivity):
    """Without a specified conductivity the gain is 1. The tolerance of the contact impedances covers the effect of
    their prior."""
    calibration = calibrate_tank(gain * homogeneous(noise=1e-6, frames=3), conductivity=conductivity)
    assert calibration.conductivity == pytest.approx(SIGMA, rel=1e-4)
    np.testing.assert_allclose(calibration.contact_impedance, CONTACTS, rtol=0.03)
    assert calibration.gain == (pytest.approx(gain, rel=1e-3) if conductivity else 1.0)


def test_reported_uncertainty_is_the_scatter_of_repetitions():
    """Errors of ln σ and ln z over six noise realisations have the reported standard deviations."""
    errors = []
    for seed in range(6):
        calibration = calibrate_tank(homogeneous(noise=0.01, frames=2, seed=seed))
        errors.append([np.log(calibration.conductivity / SIGMA) / calibration.conductivity_std,
                    *np.log(calibration.contact_impedance / CONTACTS) / calibration.contact_impedance_std])
    scatter = np.sqrt(np.mean(np.square(errors), axis=0))
    assert 0.3 < scatter[0] < 1.6
    assert 0.3 < np.sqrt(np.mean(scatter[1:]**2)) < 1.6


def test_noise_is_estimated_from_repeats_and_from_frames_of_a_moving_target():
    """Third differences cancel slow changes; too few frames give no estimate."""
    calibration = calibrate_tank(homogeneous(noise=0.01, frames=20))
    assert calibration.noise.relative == pytest.approx(0.01, rel=0.15) and calibration.noise_from_repeats
    random = np.random.default_rng(0)
    slow = 1.0 + 0.2 * np.sin(np.linspace(0, 3, 100))[:, None, None] * np.ones((100, 8, 8))
    noise = noise_from_frames(slow * (1 + 0.01 * random.normal(size=slow.shape)))
    assert np.hypot(noise.relative, noise.floor) == pytest.approx(0.01, rel=0.1)
    assert noise_from_frames(slow[:5]) is None


@pytest.mark.parametrize(("voltages", "message"), [
    (-homogeneous(), "voltages must have the sign of the model's"),
    (np.zeros((1, 8, 8)), "voltages must differ from each other, got 0 V everywhere"),
])
def test_invalid_voltages_are_rejected(voltages, message):
    with pytest.raises(ValueError, match=message):
        calibrate_tank(voltages)


SWAPPED = [0, 5, 2, 3, 4, 1, 6, 7]
"""Order of electrodes with 2 and 6 exchanged."""
GAINS = 1.0 + 0.3 * np.random.default_rng(1).uniform(-1, 1, size=8)
DEAD = np.zeros((8, 8))
DEAD[:, 4] = 0.5 * np.abs(homogeneous()).max() * np.random.default_rng(3).normal(size=8)
"""Potentials of an electrode that measures noise only."""


@pytest.mark.parametrize(("voltages", "currents", "matrix", "options", "warning"), [
    (homogeneous(noise=1e-3), CURRENTS, MATRIX, {}, ""),
    (homogeneous(), CURRENTS[:, SWAPPED], MATRIX[:, SWAPPED], {}, "Electrodes 2 and 6 seem to be swapped"),
    (homogeneous(), CURRENTS, MATRIX[:, -np.arange(8) % 8], {}, "in the opposite direction"),
    (homogeneous() * GAINS, CURRENTS, MATRIX, {}, "Exchanging injection and measurement"),
    (homogeneous() * GAINS, CURRENTS, MATRIX, {"correction": "gain"}, ""),
    (1e6 * homogeneous(), CURRENTS, MATRIX, {}, "other units"),
    (1e3 * homogeneous(), CURRENTS, MATRIX, {"conductivity": SIGMA}, "not in volts"),
    (homogeneous(noise=1e-3) + DEAD @ MATRIX.T, CURRENTS, MATRIX, {}, "Electrode 5 looks dead")])
def test_contradictions_cause_warnings(voltages, currents, matrix, options, warning):
    """Valid measurements cause no warnings."""
    measurements = Measurements(currents, np.arange(8), matrix, voltages[0], np.arange(8.0))
    calibration = calibrate(COARSE, measurements.currents, matrix, voltages, **options)
    warnings = " ".join(quality_warnings(measurements, calibration, COARSE))
    assert warning in warnings
    assert bool(warning) == bool(warnings)
