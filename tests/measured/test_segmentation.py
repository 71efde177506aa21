"""Segmentation: KTC's score against another way to compute it, and inclusions where they are."""

import numpy as np
import pytest
import yaml
from eitbench.bench.runner import run_on_measurements
from eitbench.envs.measured import MeasuredEnv
from eitbench.measured.segmentation import centroid_errors, ktc_score, read_truth, segment
from scipy.io import savemat
from scipy.signal import fftconvolve
from tanks import VESSEL, still

from commands import eitbench

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
def env():
    return MeasuredEnv(still(), VESSEL, initial_std=0.5)


def test_bodies_of_an_estimate_are_where_they_are(env):
    """Of any estimate: row 0 is the top, and columns go to the right."""
    background = env.task.expected_concentration
    x, y = env.task.mesh.points.T
    estimate = background * np.exp(-2.0 * np.exp(-((x - 0.05)**2 + y**2) / 0.02**2)
                                   + 3.0 * np.exp(-((x + 0.03)**2 + (y - 0.05)**2) / 0.025**2))
    found = segment(env.vessel, env.task, estimate)
    assert set(np.unique(found)) == {0, 1, 2}
    # half of a Gaussian's extreme is at √ln 2 of its width
    assert (found == 1).sum() == pytest.approx((disk(0.05, 0.0, 0.02 * np.log(2)**0.5, 1)).sum(), rel=0.1)
    assert max(centroid_errors(env.vessel, PICTURE, found)) < 2e-3
    assert centroid_errors(env.vessel, PICTURE, np.zeros_like(PICTURE)) == [np.inf, np.inf]


def test_homogeneous_fluid_has_no_bodies(env):
    level = np.full(env.task.mesh.n_nodes, 1.5 * env.task.expected_concentration)
    assert not segment(env.vessel, env.task, level).any()


def test_a_record_of_a_body_shows_it(env):
    """By a method that is told nothing of bodies: less than 1 cm off, in a tank of 20 cm."""
    found = segment(env.vessel, env.task, run_on_measurements(env, "log_map").mean[-1], min_contrast=0.3)
    (off,) = centroid_errors(env.vessel, disk(0.05, 0.0, 0.02, 1), found)
    assert off < 0.01


def test_truths_that_are_none_are_explained(tmp_path):
    savemat(tmp_path / "small.mat", {"truth": PICTURE[:100]})
    savemat(tmp_path / "other.mat", {"truth": PICTURE + 1})
    savemat(tmp_path / "named.mat", {"picture": PICTURE})
    for name, words in {"small": "256 × 256", "other": "0, 1 and 2", "named": "must hold truth"}.items():
        with pytest.raises(ValueError, match=words):
            read_truth(tmp_path / f"{name}.mat")


def test_command_scores_by_a_truth(tmp_path):
    """And says so on the page; a vessel that is no tank is refused before anything is played."""
    still().save(tmp_path / "still.h5")
    savemat(tmp_path / "truth.mat", {"truth": disk(0.05, 0.0, 0.02, 1)})
    (tmp_path / "tank.yml").write_text(yaml.safe_dump(VESSEL))
    given = ["estimate", tmp_path / "still.h5", "--baseline", "homogeneous", "--truth", tmp_path / "truth.mat",
             "--vessel", tmp_path / "tank.yml", "--out", tmp_path / "page.html"]
    code, said, err = eitbench(*given)
    assert code == 0, err
    assert "KTC score" in said
    assert "1 of 1 inclusions missing" in said
    assert "Ground truth" in (tmp_path / "page.html").read_text("utf-8")
    (tmp_path / "tank.yml").write_text("kind: rectangle\nlength: 0.2\nwidth: 0.05\nelectrodes: 8\ncover: 0.5\n")
    code, _, err = eitbench(*given[:-1], tmp_path / "other.html")
    assert code == 2
    assert "must be a circle" in err
    assert not (tmp_path / "other.html").exists()
