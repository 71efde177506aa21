"""Segmentation: the KTC score against an independent computation, and positions of inclusions."""

import numpy as np
import pytest
import yaml
from eitbench.envs.measured import MeasuredEnv
from eitbench.measured.segmentation import centroid_errors, ktc_score, read_truth, segment
from scipy.io import savemat
from scipy.signal import fftconvolve
from tanks import VESSEL, stationary

from commands import eitbench

pytestmark = pytest.mark.usefixtures("coarse")
SIDE = ((np.arange(256) + 0.5) / 256 * 2.0 - 1.0) * 0.1
X, Y = np.meshgrid(SIDE, -SIDE)


def disk(x, y, radius, kind):
    return np.where(np.hypot(X - x, Y - y) < radius, kind, 0)


TRUTH = disk(0.05, 0.0, 0.02, 1) + disk(-0.03, 0.05, 0.025, 2)


def similarity(a, b):
    """Return the structural similarity under a Gaussian window of 80 pixels, by 2D convolution."""
    pixels = np.arange(-160, 161)
    window = np.exp(-0.5 * (pixels[:, None]**2 + pixels**2) / 80.0**2)

    def smooth(image):
        return (fftconvolve(image, window)[160:416, 160:416]
                / fftconvolve(np.ones((256, 256)), window)[160:416, 160:416])

    ma, mb = smooth(a), smooth(b)
    va, vb, ab = smooth(a * a) - ma**2, smooth(b * b) - mb**2, smooth(a * b) - ma * mb
    return np.mean((2 * ma * mb + 1e-4) * (2 * ab + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4)))


def test_score_is_the_mean_similarity_of_both_classes():
    estimate = disk(0.045, 0.01, 0.02, 1) + disk(-0.03, 0.03, 0.02, 2)
    expected = np.mean([similarity(1.0 * (kind == TRUTH), 1.0 * (estimate == kind)) for kind in (1, 2)])
    assert ktc_score(TRUTH, estimate) == pytest.approx(expected, abs=1e-9)
    assert ktc_score(TRUTH, TRUTH) == pytest.approx(1.0)


@pytest.fixture(scope="module")
def env(coarse):
    return MeasuredEnv(stationary(), VESSEL, initial_std=0.5)


def test_inclusions_of_an_estimate_have_their_positions(env):
    """Row 0 is the top, and columns go to the right. Homogeneous fluid has no inclusions."""
    background = env.task.expected_concentration
    assert not segment(env.vessel, env.task, np.full(env.task.mesh.n_nodes, 1.5 * background)).any()
    x, y = env.task.mesh.points.T
    estimate = background * np.exp(-2.0 * np.exp(-((x - 0.05)**2 + y**2) / 0.02**2)
                                   + 3.0 * np.exp(-((x + 0.03)**2 + (y - 0.05)**2) / 0.025**2))
    classes = segment(env.vessel, env.task, estimate)
    assert set(np.unique(classes)) == {0, 1, 2}
    # a Gaussian has half of its maximum at √ln 2 of its width
    assert (classes == 1).sum() == pytest.approx((disk(0.05, 0.0, 0.02 * np.log(2)**0.5, 1)).sum(), rel=0.1)
    assert max(centroid_errors(env.vessel, TRUTH, classes)) < 2e-3
    assert centroid_errors(env.vessel, TRUTH, np.zeros_like(TRUTH)) == [np.inf, np.inf]


def test_invalid_ground_truths_are_rejected(tmp_path):
    savemat(tmp_path / "small.mat", {"truth": TRUTH[:100]})
    savemat(tmp_path / "other.mat", {"truth": TRUTH + 1})
    savemat(tmp_path / "named.mat", {"other": TRUTH})
    for name, message in {"small": "256 × 256", "other": "0, 1 and 2", "named": "must hold truth"}.items():
        with pytest.raises(ValueError, match=message):
            read_truth(tmp_path / f"{name}.mat")


def test_command_scores_by_a_ground_truth(tmp_path):
    """The page shows it; a vessel other than a tank is rejected before any method runs."""
    stationary().save(tmp_path / "still.h5")
    savemat(tmp_path / "truth.mat", {"truth": disk(0.05, 0.0, 0.02, 1)})
    (tmp_path / "tank.yml").write_text(yaml.safe_dump(VESSEL))
    arguments = ["estimate", tmp_path / "still.h5", "--baseline", "homogeneous", "--truth", tmp_path / "truth.mat",
             "--still", "--vessel", tmp_path / "tank.yml", "--out", tmp_path / "page.html"]
    code, output, err = eitbench(*arguments)
    assert code == 0, err
    assert "KTC score" in output
    assert "1 of 1 inclusions missing" in output
    assert "Ground truth" in (tmp_path / "page.html").read_text("utf-8")
    (tmp_path / "tank.yml").write_text("kind: rectangle\nlength: 0.2\nwidth: 0.05\nelectrodes: 8\ncover: 0.5\n")
    code, _, err = eitbench(*arguments[:-1], tmp_path / "other.html")
    assert code == 2
    assert "must be a circle" in err
    assert not (tmp_path / "other.html").exists()
