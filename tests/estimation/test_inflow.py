"""Inflow-window filters are compared with dense conditioning, the transport and finite differences; priors with the law
of their samples."""

import numpy as np
import pytest
from eitbench.bench.methods import baseline_folder
from eitbench.data.episodes import cached_truth_model, simulate
from eitbench.estimation import (
    Filter,
    InflowPrior,
    InflowWindow,
    compatible_priors,
    fit_inflow_prior,
    full_window_filter,
    maximise_posterior,
    time_varying_responses,
)
from eitbench.worlds.catalogue import PIPE_2D_OBSTACLE
from eitbench.worlds.catalogue import ROTATING_TANK_2D as ROTATING_TANK
from eitbench.worlds.task import make_task
from models import tiny_prior as prior
from models import tiny_record
from models import tiny_task as task
from scipy.linalg import toeplitz

from short import TINY

LEVEL = 29.0


def window(link="logarithm", lag=0, law=None):
    return InflowWindow(task(), law or prior(link), LEVEL, lag)


def some_inflows(space):
    return 0.5 * np.random.default_rng(1).standard_normal(2 * space.window_steps)


def stepped(inflow, transports):
    """Return the concentration after inflows (W, n_inlet), the oldest first, by the transport of
    each step, from a pipe at `LEVEL`."""
    state = np.full(transports[0].mesh.n_nodes, LEVEL)
    before = np.full(inflow.shape[1], LEVEL)
    for after, transport in zip(inflow, transports, strict=True):
        state = transport.step(state, before, after)
        before = after
    return state


def test_responses_of_a_time_varying_flow():
    """Responses agree with steps of the transport of each time; before t = 0 the first transport holds."""
    nominal, faster = (make_task(TINY.with_changes({"flow": {"mean_velocity": speed}})).transport
                       for speed in (45.0, 60.0))
    transports = [nominal, faster, nominal]
    response = time_varying_responses(lambda t: transports[t - 1], 3)[-1]
    K, inlet = response.weights.shape[1:]
    inflow = LEVEL + np.random.default_rng(5).standard_normal((K + 2, inlet))            # the oldest first
    change = stepped(inflow, [transports[max(k - K + 1, 0)] for k in range(K + 2)]) - LEVEL
    made = response.basis @ np.tensordot(response.weights, inflow[::-1][:K] - LEVEL, 2)
    assert np.linalg.norm(made - change) < 0.02 * np.linalg.norm(change)                 # 0.01 is forgotten


@pytest.mark.parametrize(("link", "lag"), [("linear", 0), ("logarithm", 2)])
def test_window_agrees_with_the_transport(link, lag):
    """Concentrations agree with the transport to 3e-3 of their change, the truncated part of the
    response, and derivatives by each of the last inflows with central differences."""
    space = window(link, lag)
    mean = some_inflows(space)
    u = mean.reshape(-1, 2)[lag:lag + space.response_steps][::-1] @ prior(link).modes.T
    inflow = LEVEL * (np.exp(u) if link == "logarithm" else 1.0 + u)
    expected = stepped(inflow, [task().transport] * len(inflow))
    off = space.concentration(mean, lag) - expected
    assert np.linalg.norm(off) < 3e-3 * np.linalg.norm(expected - LEVEL)
    slope = space.jacobian(mean, np.eye(task().mesh.n_nodes)[::40], lag=lag)
    for k in (0, 1, 2 * space.response_steps - 1):
        step = np.zeros_like(mean)
        step[2 * lag + k] = 1e-4
        ahead, behind = (space.concentration(mean + sign * step, lag)[::40] for sign in (1, -1))
        np.testing.assert_allclose(slope[:, k], (ahead - behind) / 2e-4, atol=1e-6 * LEVEL)


def test_prediction_keeps_the_prior():
    """Without measurements, mean and covariance of the stationary process do not change."""
    filter_ = Filter(window())
    before = filter_.covariance.array.copy()
    for _ in range(30):
        filter_.predict()
    np.testing.assert_allclose(filter_.covariance.array, before, atol=1e-10)
    assert not filter_.mean.any()


def test_map_estimate_maximises_the_density():
    """Steps in ten random directions, and the result of the linear smoother, have a lower density, also if a reading
    of an injection is missing."""
    measurements = tiny_record()
    measurements[1][0][2] = np.nan
    smoother = full_window_filter(task(), prior(), LEVEL, measurements)
    first, space = smoother.mean.copy(), smoother.space
    maximise_posterior(smoother, task(), measurements)
    precision = np.linalg.inv(toeplitz(prior().time_covariance(space.window_steps)))

    def computed(x):
        return np.array([task().observation.voltages(space.concentration(x, len(measurements) - 1 - t), I[None])[0]
                         for t, (_, I) in enumerate(measurements)])

    std, voltages = task().noise.std(computed(first)), np.array([V for V, _ in measurements])

    def surprise(x):
        prior_term = np.einsum("ik,ij,jk->", x.reshape(-1, 2), precision, x.reshape(-1, 2))
        return prior_term + np.nansum(((voltages - computed(x)) / std)**2)

    least, random = surprise(smoother.mean), np.random.default_rng(2)
    assert least < surprise(first)
    for _ in range(10):
        step = 0.05 * random.standard_normal(first.shape)
        assert min(surprise(smoother.mean + step), surprise(smoother.mean - step)) > least


def test_fits_the_law_of_the_samples():
    """For u = E x with x autoregressive, ρ = 0.7, Γ_across and the correlation converge with the number of episodes."""
    random = np.random.default_rng(4)
    E = np.array([[0.2, 0.0], [0.15, 0.1], [0.0, 0.2]])
    off = []
    for episodes in (5, 1000):
        x = np.zeros((episodes, 100, 2))
        x[:, 0] = random.standard_normal((episodes, 2))
        for t in range(1, 100):
            x[:, t] = 0.7 * x[:, t - 1] + np.sqrt(1 - 0.7**2) * random.standard_normal((episodes, 2))
        learned = fit_inflow_prior(np.exp(x @ E.T), np.zeros((3, 2)), 0.005, nugget=0.0)
        off.append(np.abs(learned.modes @ learned.modes.T - E @ E.T).max() / (E @ E.T).max())
        np.testing.assert_allclose(learned.correlation[:4], 0.7**np.arange(4), atol=0.1)
    assert off[1] < 0.03 and off[1] < off[0] / 3


def test_correlation_is_positive_semidefinite():
    random = np.random.default_rng(6)
    for _ in range(20):
        ratios = np.exp(0.1 * random.standard_normal((2, 30, 3)).cumsum(axis=1))
        learned = fit_inflow_prior(ratios, np.zeros((3, 2)), 0.01)
        values = np.linalg.eigvalsh(toeplitz(learned.time_covariance(60)))
        assert values.min() > -1e-9


def test_inflows_are_those_of_the_simulation():
    """Sampled inflows equal the simulated concentration at common inlet nodes of truth and model."""
    sampled = TINY.sample_inflow(3)
    assert sampled.shape == (TINY.spin_up_steps + TINY.n_steps + 1, 21)
    truth = cached_truth_model(TINY).transport
    fine = truth.mesh.points[truth.inlet][:, 1]
    coarse = task().mesh.points[task().transport.inlet][:, 1]
    same = [(i, k) for i, y in enumerate(coarse) for k, z in enumerate(fine) if abs(y - z) < 1e-9]
    assert len(same) > 5
    here, there = map(list, zip(*same, strict=True))
    simulated = simulate(TINY, 3).concentration[:, truth.inlet]
    np.testing.assert_allclose(sampled[TINY.spin_up_steps:, here], simulated[:, there], rtol=1e-6)


def test_files_round_trip(tmp_path):
    prior().save(tmp_path / "a.json")
    again = InflowPrior.load(tmp_path / "a.json")
    np.testing.assert_allclose(again.modes, prior().modes, rtol=1e-8)
    np.testing.assert_allclose(again.correlation, prior().correlation, rtol=1e-8)
    assert (again.link, again.time_step) == ("logarithm", prior().time_step)
    assert compatible_priors(tmp_path, task(), "logarithm")
    assert not compatible_priors(tmp_path, task(), "linear")
    assert not compatible_priors(tmp_path, make_task(ROTATING_TANK), "logarithm")


def test_inlets_are_compared_with_a_tolerance():
    """The obstacle's inlet nodes, nanometres from the straight pipe's, match; the inlet of half a pipe does not."""
    shipped = InflowPrior.load(baseline_folder() / "priors" / "pipe2d-logarithm.json")
    assert shipped.matches_task(make_task(PIPE_2D_OBSTACLE))
    narrow = TINY.with_changes({"vessel": {"half_width": 0.04}})
    assert not shipped.matches_task(make_task(narrow))


@pytest.mark.parametrize(("call", "message"), [
    (lambda: InflowWindow(make_task(ROTATING_TANK), prior(), LEVEL),
     "the prior must be for the task's inlet, 0 nodes"),
    (lambda: InflowPrior("linear", prior().points, prior().modes, np.array([0.9, 0.1]), 0.005),
     "correlation must begin with 1"),
    (lambda: fit_inflow_prior(np.full((1, 40, 3), -1.0), np.zeros((3, 2)), 0.005),
     "ratios must be above 0, got -1"),
    (lambda: fit_inflow_prior(np.ones((1, 40, 3)), np.zeros((3, 2)), 0.005), "ratios must vary"),
    *((text, r"a\.json must be a prior of `eitbench fit prior`")
      for text in ("{", '{"link": "linear"}'))])
def test_invalid_arguments_and_files_are_rejected(call, message, tmp_path):
    if isinstance(call, str):
        (tmp_path / "a.json").write_text(call)
    with pytest.raises(ValueError, match=message):
        InflowPrior.load(tmp_path / "a.json") if isinstance(call, str) else call()
