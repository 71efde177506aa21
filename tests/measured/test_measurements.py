"""`Measurements`: validation, files, frames and selection."""

import tracemalloc

import h5py
import numpy as np
import pytest
from eitbench.envs.measured import MeasuredEnv
from eitbench.measured import Measurements, read
from tanks import VESSEL, moving

pytestmark = pytest.mark.usefixtures("coarse")
PAIR = np.array([[1.0, -1.0, 0.0], [0.0, 1.0, -1.0]])


def small(**changes):
    """Two injections, three measurement vectors, one missing value."""
    arguments = {"currents": PAIR, "injection_index": np.array([0, 1, 0]), "matrix": np.eye(3),
                 "voltages": np.array([[1.0, 2, 3], [4, np.nan, 6], [7, 8, 9]]),
                 "times": np.array([0.0, 0.1, 0.2])}
    return Measurements(**arguments | changes)


@pytest.mark.parametrize(("changes", "message"), [
    ({"currents": np.array([[1.0, -0.5, 0.0], [0, 1, -1]])}, "currents must sum to zero.*0.5 A"),
    ({"currents": np.array([[1.0, -1, 0], [0, 0, 0]])}, "currents must not be 0 at all electrodes, got injection 1"),
    ({"currents": PAIR[[0, 0]]}, "2 different injections"),
    ({"matrix": np.eye(4)}, "matrix.*3"),
    ({"voltages": np.ones((3, 2))}, r"voltages must have shape \(any, 3\), got \(3, 2\)"),
    ({"voltages": np.full((3, 3), np.nan)}, "voltages must hold numbers, got NaN only"),
    ({"voltages": np.full((3, 3), np.inf)}, "voltages must be finite or NaN"),
    ({"injection_index": np.array([0, 1, 2])}, "injection_index must be from 0 to 1, got 0 to 2"),
    ({"times": np.array([0.0, 0.2, 0.1])}, "times must increase, got 0.2 s and then 0.1 s"),
    ({"reference": np.ones((1, 3, 3))}, "reference must have shape"),
])
def test_contradictory_fields_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        small(**changes)


def test_file_restores_all_fields(tmp_path):
    """A slice of the measurement vectors can be loaded alone."""
    measurements = moving(frames=2)
    path = measurements.save(tmp_path / "moving.h5")
    loaded = Measurements.load(path)
    for name in ("currents", "injection_index", "matrix", "voltages", "times", "reference"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(measurements, name))
    assert loaded.source == measurements.source
    with h5py.File(path) as file:                             # names of format version 1
        assert set(file) == {"currents", "injections", "matrix", "readings", "times", "reference"}
    part = read(path, steps=slice(8, 12))
    np.testing.assert_array_equal(part.voltages, measurements.voltages[8:12])


def test_broken_files_are_named(tmp_path):
    path = moving(frames=1).save(tmp_path / "moving.h5")
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(ValueError, match=r"moving\.h5 must be a file of measurements"):
        Measurements.load(path)


def test_equal_injections_are_merged():
    """They keep the order of first use; the reference is sorted in the same way."""
    currents = PAIR[[1, 0, 1]]
    reference = np.arange(9.0).reshape(1, 3, 3)
    merged = Measurements.from_sequence(currents, np.eye(3), np.ones((3, 3)), np.arange(3.0), reference)
    np.testing.assert_array_equal(merged.currents, PAIR[[1, 0]])
    np.testing.assert_array_equal(merged.injection_index, [0, 1, 0])
    np.testing.assert_array_equal(merged.reference[0, 0], reference[0, 0])
    np.testing.assert_array_equal(merged.reference[1, 0], reference[0, 2])
    assert np.isnan(merged.reference[1, 1]).all()
    assert merged.frame_length == 2


def test_frames_are_consecutive():
    """A frame ends with the first use of the last injection, even if some are never used."""
    measurements = moving(frames=3)
    frames = measurements.frames(5)
    assert frames.shape == (3, 8, 8)
    np.testing.assert_array_equal(frames[1, 3], measurements.voltages[11])
    incomplete = Measurements(measurements.currents, np.array([0, 1, 0, 2, 1, 4, 0]), measurements.matrix,
                              measurements.voltages[:7], np.arange(7.0))
    assert incomplete.frame_length == 6


def test_large_files_are_memory_mapped(tmp_path, monkeypatch):
    """Loading, calibration and a first step need less than half of the file's size more memory than for a short
    file, with the same result."""
    monkeypatch.setattr("eitbench.measured.measurements.MAX_IN_MEMORY_BYTES", 1 << 22)
    short = moving(frames=6)
    repeats = 3000
    large = Measurements(short.currents, np.tile(short.injection_index, repeats), short.matrix,
                         np.tile(short.voltages, (repeats, 1)), 0.01 * np.arange(48 * repeats), short.reference)
    size = large.voltages.nbytes
    assert size > 1 << 23
    paths = large.select(slice(0, 480)).save(tmp_path / "short.h5"), large.save(tmp_path / "large.h5")
    del large

    def first_step(path):
        tracemalloc.start()
        env = MeasuredEnv(path, VESSEL, moves=False, initial_std=0.2)
        observation, _ = env.reset(seed=0)
        env.step(np.full(env.task.mesh.n_nodes, env.task.expected_concentration))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return env.measurements, observation["voltages"], peak

    (short, short_voltages, short_peak), (long, long_voltages, long_peak) = map(first_step, paths)
    assert long_peak - short_peak < size / 2
    assert not long.voltages.flags.writeable
    np.testing.assert_array_equal(short_voltages, long_voltages)
    np.testing.assert_array_equal(long.voltages[48_000:48_480], short.voltages)
    with pytest.raises(ValueError, match=r"large.h5.*steps must select some of the 144000 measurement vec"):
        read(paths[1], steps=slice(2_000_000, None))


def test_selection_keeps_the_used_injections():
    """The reference keeps the same injections."""
    measurements = moving(frames=3)
    part = measurements.select(slice(9, 12))
    np.testing.assert_array_equal(part.voltages, measurements.voltages[9:12])
    np.testing.assert_array_equal(part.currents[part.injection_index],
                                  measurements.currents[measurements.injection_index[9:12]])
    np.testing.assert_array_equal(part.reference, measurements.reference[:, 1:4])
