"""The container of measured records."""

import tracemalloc

import numpy as np
import pytest
from eitbench.envs.measured import MeasuredEnv
from eitbench.measured import Measurements, read
from tanks import BELIEVED, VESSEL, moving

PAIR = np.array([[1.0, -1.0, 0.0], [0.0, 1.0, -1.0]])


def small(**changed):
    """Two injections, three readings, one of them missing."""
    given = {"currents": PAIR, "injections": np.array([0, 1, 0]), "matrix": np.eye(3),
             "readings": np.array([[1.0, 2, 3], [4, np.nan, 6], [7, 8, 9]]),
             "times": np.array([0.0, 0.1, 0.2])}
    return Measurements(**given | changed)


@pytest.mark.parametrize(("changed", "said"), [
    ({"currents": np.array([[1.0, -0.5, 0.0], [0, 1, -1]])}, "currents must sum to zero.*0.5 A"),
    ({"currents": np.array([[1.0, -1, 0], [0, 0, 0]])}, "currents must flow.*injection 1"),
    ({"currents": PAIR[[0, 0]]}, "2 different injections"),
    ({"matrix": np.eye(4)}, "matrix.*3"),
    ({"readings": np.ones((3, 2))}, r"readings must have shape \(any, 3\), got \(3, 2\)"),
    ({"readings": np.full((3, 3), np.nan)}, "readings must hold numbers, got NaN only"),
    ({"readings": np.ones((3, 3)) * 1j}, "readings must be an array of numbers in V, got ndarray of complex128"),
    ({"readings": np.full((3, 3), b"a")}, "readings must be an array of numbers in V, got"),
    ({"readings": np.full((3, 3), np.inf)}, "readings must be finite or NaN"),
    ({"readings": np.ones((0, 3))}, "readings must hold numbers"),
    ({"injections": np.array([0, 1, 2])}, "injections must be numbers from 0 to 1, got 0 to 2"),
    ({"injections": np.array([0.0, 1, 0])}, "injections must be 3 integers"),
    ({"times": np.array([0.0, 0.2, 0.1])}, "times must increase, got 0.2 s and then 0.1 s"),
    ({"times": np.array([0.0, 0.2])}, "times"),
    ({"reference": np.ones((1, 3, 3))}, "reference must have shape"),
])
def test_what_contradicts_itself_is_said(changed, said):
    with pytest.raises(ValueError, match=said):
        small(**changed)


def test_file_holds_all(tmp_path):
    """And may be read in parts."""
    record = moving(frames=2)
    path = record.save(tmp_path / "record.h5")
    again = Measurements.load(path)
    for name in ("currents", "injections", "matrix", "readings", "times", "reference"):
        np.testing.assert_array_equal(getattr(again, name), getattr(record, name))
    assert again.source == record.source
    part = Measurements.load(path, slice(8, 12))
    np.testing.assert_array_equal(part.readings, record.readings[8:12])


def test_broken_files_are_named(tmp_path):
    path = moving(frames=1).save(tmp_path / "record.h5")
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(ValueError, match=r"record\.h5 must be a file of measurements"):
        Measurements.load(path)
    (tmp_path / "empty.h5").write_bytes(b"")
    with pytest.raises(ValueError, match="must be a file of measurements"):
        Measurements.load(tmp_path / "empty.h5")


def test_equal_injections_become_one():
    """In the order in which they come first; of a reference too."""
    currents = PAIR[[1, 0, 1]]
    reference = np.arange(9.0).reshape(1, 3, 3)
    record = Measurements.from_sequence(currents, np.eye(3), np.ones((3, 3)), np.arange(3.0),
                                      reference)
    np.testing.assert_array_equal(record.currents, PAIR[[1, 0]])
    np.testing.assert_array_equal(record.injections, [0, 1, 0])
    np.testing.assert_array_equal(record.reference[0, 0], reference[0, 0])
    np.testing.assert_array_equal(record.reference[1, 0], reference[0, 2])
    assert np.isnan(record.reference[1, 1]).all()
    assert record.frame == 2


def test_frames_follow_each_other():
    """A frame ends with the first use of the last injection, even if some are never used."""
    sound = moving(frames=3)
    frames = sound.frames(5)
    assert frames.shape == (3, 8, 8)
    np.testing.assert_array_equal(frames[1, 3], sound.readings[11])
    some = Measurements(sound.currents, np.array([0, 1, 0, 2, 1, 4, 0]), sound.matrix, sound.readings[:7],
                        np.arange(7.0))
    assert some.frame == 6


def test_a_large_record_stays_on_the_disk(tmp_path):
    """To read it, calibrate and play a little of it takes more memory than a short one does by less than half of its
    readings, and nothing of it is another number."""
    sound = moving(frames=8)
    times = 18_000
    large = Measurements(sound.currents, np.tile(sound.injections, times), sound.matrix,
                         np.tile(sound.readings, (times, 1)), 0.01 * np.arange(64 * times), sound.reference)
    size = large.readings.nbytes
    assert size > 1 << 26
    paths = large.select(slice(0, 640)).save(tmp_path / "short.h5"), large.save(tmp_path / "large.h5")
    del large

    def first_step(path):
        tracemalloc.start()
        env = MeasuredEnv(path, VESSEL, **BELIEVED)
        observation, _ = env.reset(seed=0)
        env.step(np.full(env.task.mesh.n_nodes, env.task.expected_concentration))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return env.measurements, observation["voltages"], peak

    (short, seen, usual), (long, same, peak) = map(first_step, paths)
    assert peak - usual < size / 2
    assert not long.readings.flags.writeable
    np.testing.assert_array_equal(seen, same)
    np.testing.assert_array_equal(long.readings[640_000:640_640], short.readings)
    part = read(paths[1], steps=slice(640_000, 640_640))
    np.testing.assert_array_equal(part.readings, short.readings)
    assert part.times[0] == 6400.0
    with pytest.raises(ValueError, match=r"large.h5.*steps must hold some of its 1152000 readings, got slice"):
        read(paths[1], steps=slice(2_000_000, None))


def test_parts_of_a_record():
    """Of injections that came alone; the reference with them."""
    sound = moving(frames=3)
    part = sound.select(slice(9, 12))
    np.testing.assert_array_equal(part.readings, sound.readings[9:12])
    np.testing.assert_array_equal(part.currents[part.injections], sound.currents[sound.injections[9:12]])
    np.testing.assert_array_equal(part.reference, sound.reference[:, 1:4])
    with pytest.raises(ValueError, match="steps must hold readings of the 24, got"):
        sound.select(slice(30, 40))
