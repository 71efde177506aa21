"""The ensemble filter agrees with the Kalman update of its moments, the transport of each member, and the exact
filter."""

from dataclasses import replace

import numpy as np
import pytest
from eitbench.estimation import (
    EnsembleFilter,
    Filter,
    InflowWindow,
    inflow_response,
    linearise_at_prediction,
)
from models import MESH, averaged, coarse_prior, coarse_task, coarse_transport, flow_prior
from models import textbook_update as textbook

LEVEL = 29.0


def ensemble(link="logarithm", members=40, std=0.5, spin_up_steps=24):
    flow = flow_prior([4.5], [std], [0.1 * std])
    return EnsembleFilter(coarse_task(), coarse_prior(link), LEVEL, flow, members, spin_up_steps,
                          np.random.default_rng(0), linearise_at_prediction(coarse_task()))


def together(filter_):
    """Return the stacked states (n + P·r + k, N) of the members."""
    return np.concatenate([filter_.concentration, filter_.inflows.reshape(-1, filter_.inflows.shape[-1]),
                           filter_.parameters])


def test_a_measurement_is_the_kalman_update_of_the_members_moments():
    """Concentration, inflows and velocity agree with the update by a dense gain to 1e-9 of the largest entry."""
    filter_ = ensemble()
    filter_.predict()
    before = together(filter_)
    seen = averaged(np.random.default_rng(5), 6)
    filter_.update(seen)
    estimate = filter_.estimate()
    innovation, covariance = estimate.innovation, estimate.innovation_covariance
    n, P = len(MESH.points), np.cov(before)
    mean, less, S = textbook(before.mean(axis=1), P, *seen[:3])
    np.testing.assert_allclose(innovation, seen.value - seen.matrix @ before[:n].mean(axis=1), rtol=1e-9)
    np.testing.assert_allclose(covariance, S, rtol=1e-9)
    after = together(filter_)
    np.testing.assert_allclose(after.mean(axis=1), mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(np.cov(after), less, atol=1e-9 * np.abs(P).max())
    np.testing.assert_allclose(estimate.variance, np.cov(after).diagonal()[:n], rtol=1e-9)
    np.testing.assert_allclose(filter_.covariance_of(seen.matrix), seen.matrix @ np.cov(after)[:n, :n] @ seen.matrix.T,
                               rtol=1e-9)


def test_members_are_advected_with_their_velocities():
    """For velocities at least 0.1 m/s from the mean the error is at most 2 % of the error of the mean velocity."""
    filter_ = ensemble(std=0.4, members=24)
    filter_.flow = replace(filter_.flow, walk_std=np.zeros(1))
    before = filter_.concentration.copy()
    entered = filter_.c_ref * np.exp(filter_.prior.modes @ filter_.inflows[0])
    filter_.predict()
    enters = filter_.c_ref * np.exp(filter_.prior.modes @ filter_.inflows[0])
    own, mean = (np.stack([coarse_transport(theta).step(before[:, i], entered[:, i], enters[:, i])
                           for i, theta in enumerate(flows)], axis=1)
                 for flows in (filter_.parameters.T, np.tile(filter_.parameters.mean(axis=1), (24, 1))))
    assert np.abs(filter_.concentration - own).max() < 0.02 * np.abs(mean - own).max()


def test_many_members_give_the_kalman_filter(monkeypatch):
    """For a linear prior, known flow and full spin-up the mean after four measurement vectors agrees to a tenth (rms)
    of its change, and variances to 15 %, five standard errors of 2,000 members."""
    monkeypatch.setattr(inflow_response, "DECAY_TOLERANCE", 1e-6)
    filter_ = ensemble("linear", 2000, std=0.0, spin_up_steps=60)
    exact = Filter(InflowWindow(coarse_task(), coarse_prior("linear"), LEVEL))
    for seed in range(4):
        for each in (filter_, exact):
            each.predict()
        seen = averaged(np.random.default_rng(seed), 2, variance=1.0)
        filter_.update(seen)
        exact.update(seen)
    ours, theirs = filter_.estimate(), exact.estimate()
    assert np.linalg.norm(ours.mean - theirs.mean) < 0.1 * np.linalg.norm(theirs.mean - LEVEL)
    np.testing.assert_allclose(ours.variance, theirs.variance, rtol=0.15)
    np.testing.assert_array_equal(filter_.parameters, 4.5)


def test_invalid_arguments_are_rejected():
    with pytest.raises(ValueError, match="members must be"):
        ensemble(members=1)
