"""Smooth motion: the Matérn-3/2 process in time, its modes, and the prediction of withheld measurements."""

import numpy as np
import pytest
from eitbench.bench.runner import run_on_measurements
from eitbench.envs.measured import MeasuredEnv
from eitbench.estimation.walk import matern32_transition, matern_modes
from tanks import VESSEL, moving


def test_correlation_is_matern():
    """The correlation is (1 + λτ) e^−λτ; short steps compose to a long step, and the variance is
    stationary. Q is ∫ e^Fs L Lᵀ e^Fᵀs ds of dx = F x dt + L dw, with λ = 1 and a spectral density
    of 4."""
    for phase in (0.1, 1.0, 4.0):
        A, Q = matern32_transition(phase)
        assert A[0, 0] == pytest.approx((1 + phase) * np.exp(-phase))
        np.testing.assert_allclose(A @ A.T + Q, np.eye(2))
        assert np.linalg.eigvalsh(Q).min() > -1e-15
        short, _ = matern32_transition(phase / 8)
        np.testing.assert_allclose(np.linalg.matrix_power(short, 8), A, atol=1e-12)
    phase = 0.7
    s = (np.arange(20_000) + 0.5) / 20_000 * phase
    responses = np.array([matern32_transition(each)[0] @ [0.0, 1.0] for each in s])
    np.testing.assert_allclose(matern32_transition(phase)[1], 4 * responses.T @ responses * phase / len(s),
                               rtol=1e-6, atol=1e-9)


def test_modes_reproduce_the_covariance_of_the_field(env):
    """The residual is at most a thousandth of the variance of the strongest mode."""
    walk = env.task.transport
    modes = matern_modes(walk.mesh, walk.length)
    strongest = (modes**2).sum(axis=0).max()
    residual = np.linalg.eigvalsh(walk.covariance - modes @ modes.T)
    assert -1e-9 * strongest < residual.min()
    assert residual.max() <= 1.001e-3 * strongest


def test_smooth_motion_predicts_better_than_a_random_walk(coarse):
    """The withheld RMSE is at least a tenth smaller for an inclusion that moves half round a tank in 12 frames."""
    env = MeasuredEnv(moving(frames=12), VESSEL, withheld=0.15)
    random_walk, smooth_motion = (run_on_measurements(env, name).withheld_rmse
                                  for name in ("log_walk_filter", "log_steady_filter"))
    assert smooth_motion < 0.9 * random_walk
