"""What homogeneous fluid tells: conductivity, contact impedances, noise; and what is odd."""

import numpy as np
import pytest
from eitbench.measured import Measurements
from eitbench.measured.calibration import calibrate, noise_of_frames
from eitbench.measured.quality import quality_warnings
from eitbench.measured.vessel import read_vessel
from tanks import CONTACTS, SIGMA, VESSEL, homogeneous, instrument, moving

CURRENTS, MATRIX = instrument()
VESSEL_HERE = read_vessel(VESSEL)
ELECTRODES = VESSEL_HERE.electrode_model(1e-4)


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


def record_of(readings, currents=CURRENTS, matrix=MATRIX):
    return Measurements(currents, np.arange(8), matrix, readings[0], np.arange(8.0))


def warnings_of(readings, currents=CURRENTS, matrix=MATRIX, **more):
    record = record_of(readings, currents, matrix)
    calibration = calibrate(ELECTRODES, record.currents, record.matrix, readings, **more)
    return " ".join(quality_warnings(record, calibration, ELECTRODES))


def test_a_sound_record_has_no_warnings():
    assert warnings_of(homogeneous(noise=1e-3)) == ""


def test_swapped_electrodes_are_named():
    """The wires of electrodes 2 and 6: injections and readings name one for the other."""
    order = np.arange(8)
    order[[1, 5]] = 5, 1
    assert "Electrodes 2 and 6 are swapped" in warnings_of(
        homogeneous(), CURRENTS[:, order], MATRIX[:, order])


def test_readings_counted_the_other_way_are_named():
    said = warnings_of(homogeneous(), CURRENTS, MATRIX[:, -np.arange(8) % 8])
    assert "the other way round" in said


def test_channels_that_amplify_differently_break_reciprocity():
    """By what they differ."""
    gains = 1.0 + 0.3 * np.random.default_rng(1).uniform(-1, 1, size=8)
    assert "Exchanging injection and reading" in warnings_of(homogeneous() * gains)
    assert warnings_of(homogeneous() * gains, correction="gain") == ""


def test_gains_excuse_no_swapped_electrodes():
    order = np.arange(8)
    order[[1, 5]] = 5, 1
    assert "Electrodes 2 and 6 are swapped" in warnings_of(
        homogeneous(), CURRENTS[:, order], MATRIX[:, order], correction="gain")


def test_units_that_are_wrong_are_named():
    assert "other units" in warnings_of(1e6 * homogeneous())
    assert "other units" in warnings_of(homogeneous(), 1e3 * CURRENTS)
    assert "not in volts" in warnings_of(1e3 * homogeneous(), conductivity=SIGMA)


def test_a_dead_electrode_is_named():
    """Which reads noise, whatever is injected."""
    readings = homogeneous(noise=1e-3)
    potential = np.zeros((8, 8))
    potential[:, 4] = 0.5 * np.abs(readings).max() * np.random.default_rng(3).normal(size=8)
    assert "Electrode 5 looks dead" in warnings_of(readings + potential @ MATRIX.T)


def test_moving_record_is_sound():
    record = moving(frames=2)
    found = calibrated(record.homogeneous())
    assert found.noise.relative == pytest.approx(1e-3, rel=0.4)
