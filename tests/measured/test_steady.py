"""Targets that move steadily: the process in time, its filter against a dense one, and what it is good for."""

import numpy as np
import pytest
from eitbench.bench.runner import run_on_measurements
from eitbench.envs.measured import MeasuredEnv
from eitbench.estimation.walk import smooth_modes, steady
from tanks import BELIEVED, VESSEL, moving


def test_correlation_is_that_of_a_matern_process():
    """Of order 3/2: (1 + λτ) e^−λτ; many short steps make a long one, and the variance stays."""
    for phase in (0.1, 1.0, 4.0):
        A, Q = steady(phase)
        assert A[0, 0] == pytest.approx((1 + phase) * np.exp(-phase))
        np.testing.assert_allclose(A @ A.T + Q, np.eye(2))
        assert np.linalg.eigvalsh(Q).min() > -1e-15
        short, _ = steady(phase / 8)
        np.testing.assert_allclose(np.linalg.matrix_power(short, 8), A, atol=1e-12)


def test_what_is_new_is_what_white_noise_leaves():
    """Q is ∫ e^Fs L Lᵀ e^Fᵀs ds of dx = F x dt + L dw, with λ = 1 and a spectral density of 4."""
    phase = 0.7
    s = (np.arange(20_000) + 0.5) / 20_000 * phase
    moved = np.array([steady(each)[0] @ [0.0, 1.0] for each in s])
    np.testing.assert_allclose(steady(phase)[1], 4 * moved.T @ moved * phase / len(s), rtol=1e-6, atol=1e-9)


def test_modes_make_the_fields_covariance():
    """But for a thousandth of the strongest one's variance."""
    env = MeasuredEnv(moving(frames=3), VESSEL, **BELIEVED)
    walk = env.task.transport
    modes = smooth_modes(walk.mesh, walk.length)
    strongest = (modes**2).sum(axis=0).max()
    left = np.linalg.eigvalsh(walk.covariance - modes @ modes.T)
    assert -1e-9 * strongest < left.min()
    assert left.max() <= 1.001e-3 * strongest


def test_a_steady_body_is_predicted_better_than_by_a_walk():
    """A body that goes half round a tank in 12 frames: by a tenth at least, withheld readings."""
    env = MeasuredEnv(moving(frames=12), VESSEL, withheld=0.15)
    walk, steady_one = (run_on_measurements(env, name).withheld_rmse
                        for name in ("log_walk_filter", "log_steady_filter"))
    assert steady_one < 0.9 * walk
