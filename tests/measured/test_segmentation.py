"""Where the truth is a picture: KTC's score against another way to compute it, and bodies where they are."""

import os
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from eitbench.bench.measured import play_record
from eitbench.bench.measured_records import read_measured_record
from eitbench.bench.segmentation import distances, ktc_score, read_truth, segmented
from eitbench.data.measured import Measurements
from eitbench.envs.measured import MeasuredEnv
from scipy.io import loadmat, savemat
from scipy.signal import fftconvolve
from tanks import VESSEL, conductivity, homogeneous, instrument
from test_board import file_sha256, write_case

from commands import eitbench

REAL = os.environ.get("EITBENCH_REAL_FILES")
SIDE = ((np.arange(256) + 0.5) / 256 * 2.0 - 1.0) * 0.1
X, Y = np.meshgrid(SIDE, -SIDE)


def disk(x, y, radius, kind):
    return np.where(np.hypot(X - x, Y - y) < radius, kind, 0)


PICTURE = disk(0.05, 0.0, 0.02, 1) + disk(-0.03, 0.05, 0.025, 2)


def similarity(a, b):
    """Structural similarity under a Gaussian window of 80 pixels, by convolution in two dimensions."""
    far = np.arange(-160, 161)
    window = np.exp(-0.5 * (far[:, None]**2 + far**2) / 80.0**2)

    def smooth(picture):
        return (fftconvolve(picture, window)[160:416, 160:416]
                / fftconvolve(np.ones((256, 256)), window)[160:416, 160:416])

    ma, mb = smooth(a), smooth(b)
    va, vb, ab = smooth(a * a) - ma**2, smooth(b * b) - mb**2, smooth(a * b) - ma * mb
    return np.mean((2 * ma * mb + 1e-4) * (2 * ab + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4)))


def test_score_is_the_mean_similarity_of_both_classes():
    found = disk(0.045, 0.01, 0.02, 1) + disk(-0.03, 0.03, 0.02, 2)
    expected = np.mean([similarity(1.0 * (kind == PICTURE), 1.0 * (found == kind)) for kind in (1, 2)])
    assert ktc_score(PICTURE, found) == pytest.approx(expected, abs=1e-9)


def test_what_is_the_same_scores_one_and_what_is_not_less():
    assert ktc_score(PICTURE, PICTURE) == pytest.approx(1.0)
    near, far = (ktc_score(PICTURE, np.roll(PICTURE, shift, axis=1)) for shift in (5, 40))
    swapped = ktc_score(PICTURE, np.choose(PICTURE, [0, 2, 1]))
    assert 1.0 > near > far > swapped


@pytest.fixture(scope="module")
def still():
    """One frame of a body that conducts a third, at (5 cm, 0)."""
    from eitbench.worlds.vessels import RoundTank
    currents, matrix = instrument()
    model = RoundTank(radius=0.1, n_electrodes=8, electrode_cover=0.4).electrode_model(True)
    model = model.with_contacts(1e-3 * np.linspace(0.5, 2.0, 8))
    readings = currents @ model.transfer_resistance(conductivity(model.mesh.points, 0.0)) @ matrix.T
    readings *= 1.0 + 1e-3 * np.random.default_rng(5).normal(size=readings.shape)
    return Measurements(currents, np.arange(8), matrix, readings, 0.01 * np.arange(8), homogeneous(1e-3, 3),
                        {"file": "still"})


@pytest.fixture(scope="module")
def env(still):
    return MeasuredEnv(still, VESSEL, initial_std=0.5)


def test_bodies_of_an_estimate_are_where_they_are(env):
    """Of any estimate: row 0 is the top, and columns go to the right."""
    background = env.task.expected_concentration
    x, y = env.task.mesh.points.T
    estimate = background * np.exp(-2.0 * np.exp(-((x - 0.05)**2 + y**2) / 0.02**2)
                                   + 3.0 * np.exp(-((x + 0.03)**2 + (y - 0.05)**2) / 0.025**2))
    found = segmented(env, estimate)
    assert set(np.unique(found)) == {0, 1, 2}
    # half of a Gaussian's extreme is at √ln 2 of its width
    assert (found == 1).sum() == pytest.approx((disk(0.05, 0.0, 0.02 * np.log(2)**0.5, 1)).sum(), rel=0.1)
    assert max(distances(env, PICTURE, found)) < 2e-3
    assert distances(env, PICTURE, np.zeros_like(PICTURE)) == [np.inf, np.inf]


def test_homogeneous_fluid_has_no_bodies(env):
    assert not segmented(env, np.full(env.task.mesh.n_nodes, 1.5 * env.task.expected_concentration)).any()


def test_a_record_of_a_body_shows_it(env):
    """By a method that is told nothing of bodies: less than 1 cm off, in a tank of 20 cm."""
    found = segmented(env, play_record(env, "log_map").mean[-1], least=0.3)
    (off,) = distances(env, disk(0.05, 0.0, 0.02, 1), found)
    assert off < 0.01


def test_truths_that_are_none_are_explained(tmp_path):
    savemat(tmp_path / "small.mat", {"truth": PICTURE[:100]})
    savemat(tmp_path / "other.mat", {"truth": PICTURE + 1})
    savemat(tmp_path / "named.mat", {"picture": PICTURE})
    for name, words in {"small": "256 × 256", "other": "0, 1 and 2", "named": "must hold truth"}.items():
        with pytest.raises(ValueError, match=words):
            read_truth(tmp_path / f"{name}.mat")


def test_command_scores_by_a_truth(still, tmp_path):
    """And says so on the page; a vessel that is no tank is refused before anything is played."""
    import yaml
    still.save(tmp_path / "still.h5")
    savemat(tmp_path / "truth.mat", {"truth": disk(0.05, 0.0, 0.02, 1)})
    (tmp_path / "tank.yml").write_text(yaml.safe_dump(VESSEL))
    given = ["estimate", tmp_path / "still.h5", "--baseline", "homogeneous", "--truth", tmp_path / "truth.mat",
             "--vessel", tmp_path / "tank.yml", "--out", tmp_path / "page.html"]
    code, said, err = eitbench(*given)
    assert code == 0, err
    assert "KTC's score" in said
    assert "it shows none of the bodies" in said
    assert "in truth" in (tmp_path / "page.html").read_text("utf-8")
    (tmp_path / "tank.yml").write_text("kind: rectangle\nlength: 0.2\nwidth: 0.05\nelectrodes: 8\ncover: 0.5\n")
    code, _, err = eitbench(*given[:-1], tmp_path / "other.html")
    assert code == 2
    assert "must be a circle" in err
    assert not (tmp_path / "other.html").exists()


def test_records_of_a_case_with_a_truth_have_its_score(still, tmp_path):
    still.save(tmp_path / "still.h5")
    savemat(tmp_path / "truth.mat", {"truth": disk(0.05, 0.0, 0.02, 1)})
    truth = {"file": "truth.mat", "sha256": file_sha256(tmp_path / "truth.mat")}
    write_case(tmp_path / "a.yml", tmp_path / "still.h5", truth=truth)
    given = ["submit-measured", tmp_path / "a.yml", "--data", tmp_path / "still.h5", "--baseline", "homogeneous"]
    code, _, err = eitbench(*given)
    assert code == 2
    assert "truth must be truth.mat" in err
    assert eitbench(*given, "--truth", tmp_path / "truth.mat")[0] == 0
    (path,) = tmp_path.glob("*.json")
    nothing = ktc_score(disk(0.05, 0.0, 0.02, 1), np.zeros((256, 256)))
    assert [play["truth"]["ktc"] for play in read_measured_record(path)["plays"]] == pytest.approx([nothing] * 5)


@pytest.mark.skipif(not REAL, reason="EITBENCH_REAL_FILES names no folder of real files")
@pytest.mark.parametrize("tank", [1, 4])
def test_score_is_that_of_the_organisers_program(tank, monkeypatch):
    folder = Path(REAL) / "ktc"
    monkeypatch.setattr(sys, "path", [*sys.path, str(folder)])
    theirs = runpy.run_path(str(folder / "KTCScoring.py"))["scoringFunction"]
    truth = read_truth(folder / "GroundTruths" / f"true{tank}.mat")
    found = loadmat(folder / "Output" / f"{tank}.mat")["reconstruction"]
    assert ktc_score(truth, found) == pytest.approx(theirs(truth, found), abs=1e-12)
