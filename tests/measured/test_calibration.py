"""What homogeneous fluid tells: conductivity, contact impedances, noise; and what is odd."""

import numpy as np
import pytest
from eitbench.measured import Measurements
from eitbench.measured.calibration import calibrate, noise_of_frames
from eitbench.measured.quality import quality_warnings
from eitbench.measured.vessel import read_vessel
from tanks import CONTACTS, SIGMA, VESSEL, homogeneous, instrument

CURRENTS, MATRIX = instrument()
ELECTRODES = read_vessel(VESSEL).electrode_model(1e-4)


def calibrated(readings, **more):
    return calibrate(ELECTRODES, CURRENTS, MATRIX, readings, **more)


def test_exact_readings_give_back_what_they_were_made_with():
    """From four-terminal and driven readings alike, within what the drawing to a mean leaves."""
    found = calibrated(homogeneous(noise=1e-6, records=3))
    assert found.conductivity == pytest.approx(SIGMA, rel=1e-4)
    np.testing.assert_allclose(found.contact_impedance, CONTACTS, rtol=0.03)
    assert found.gain == 1.0


def test_uncertainty_is_that_of_repetitions():
    """Of noise drawn 12 times, ln σ and ln z scatter as calibration says."""
    off = []
    for seed in range(12):
        found = calibrated(homogeneous(noise=0.01, records=2, seed=seed))
        off.append([np.log(found.conductivity / SIGMA) / found.conductivity_std,
                    *np.log(found.contact_impedance / CONTACTS) / found.contact_impedance_std])
    scatter = np.sqrt(np.mean(np.square(off), axis=0))
    assert 0.3 < scatter[0] < 1.6
    assert 0.3 < np.sqrt(np.mean(scatter[1:]**2)) < 1.6


def test_repeats_tell_the_noise():
    found = calibrated(homogeneous(noise=0.01, records=20))
    assert found.noise.relative == pytest.approx(0.01, rel=0.15)
    assert found.noise_from_repeats


def test_frames_tell_the_noise_of_what_moves():
    """Third differences leave slow changes out; without enough frames nothing is told."""
    random = np.random.default_rng(0)
    slow = 1.0 + 0.2 * np.sin(np.linspace(0, 3, 100))[:, None, None] * np.ones((100, 8, 8))
    told = noise_of_frames(slow * (1 + 0.01 * random.normal(size=slow.shape)))
    assert np.hypot(told.relative, told.floor) == pytest.approx(0.01, rel=0.1)
    assert noise_of_frames(slow[:5]) is None


def test_gain_is_told_from_a_conductivity_that_is_known():
    """Readings in mV, where V are expected: everything but the gain stays."""
    found = calibrated(1e3 * homogeneous(), conductivity=SIGMA)
    assert found.gain == pytest.approx(1e3, rel=1e-3)
    np.testing.assert_allclose(found.contact_impedance, CONTACTS, rtol=0.03)


@pytest.mark.parametrize(("readings", "said"), [
    (-homogeneous(), "readings must have the sign of the model's"),
    (np.full((1, 8, 8), np.nan), "NaN only"),
    (np.zeros((1, 8, 8)), "readings must differ from each other, got 0 V everywhere"),
    (np.ones((1, 8, 7)), r"readings must have shape \(F, K, M\)"),
])
def test_bad_readings_are_said(readings, said):
    with pytest.raises(ValueError, match=said):
        calibrated(readings)


SWAPPED = [0, 5, 2, 3, 4, 1, 6, 7]
"""The wires of electrodes 2 and 6."""
GAINS = 1.0 + 0.3 * np.random.default_rng(1).uniform(-1, 1, size=8)
DEAD = np.zeros((8, 8))
DEAD[:, 4] = 0.5 * np.abs(homogeneous()).max() * np.random.default_rng(3).normal(size=8)
"""Potentials of an electrode that reads noise, whatever is injected."""


@pytest.mark.parametrize(("readings", "currents", "matrix", "options", "warning"), [
    (homogeneous(noise=1e-3), CURRENTS, MATRIX, {}, ""),
    (homogeneous(), CURRENTS[:, SWAPPED], MATRIX[:, SWAPPED], {}, "Electrodes 2 and 6 are swapped"),
    (homogeneous(), CURRENTS[:, SWAPPED], MATRIX[:, SWAPPED], {"correction": "gain"},
     "Electrodes 2 and 6 are swapped"),
    (homogeneous(), CURRENTS, MATRIX[:, -np.arange(8) % 8], {}, "the other way round"),
    (homogeneous() * GAINS, CURRENTS, MATRIX, {}, "Exchanging injection and reading"),
    (homogeneous() * GAINS, CURRENTS, MATRIX, {"correction": "gain"}, ""),
    (1e6 * homogeneous(), CURRENTS, MATRIX, {}, "other units"),
    (homogeneous(), 1e3 * CURRENTS, MATRIX, {}, "other units"),
    (1e3 * homogeneous(), CURRENTS, MATRIX, {"conductivity": SIGMA}, "not in volts"),
    (homogeneous(noise=1e-3) + DEAD @ MATRIX.T, CURRENTS, MATRIX, {}, "Electrode 5 looks dead")])
def test_contradictions_are_named(readings, currents, matrix, options, warning):
    """And sound measurements have no warnings."""
    measurements = Measurements(currents, np.arange(8), matrix, readings[0], np.arange(8.0))
    calibration = calibrate(ELECTRODES, measurements.currents, matrix, readings, **options)
    found = " ".join(quality_warnings(measurements, calibration, ELECTRODES))
    assert warning in found
    assert bool(warning) == bool(found)
