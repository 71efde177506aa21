"""Filters of the inflow's history against dense conditioning, transport by steps and finite differences; and the prior
that is learned from inflows of a known law."""

from functools import lru_cache

import numpy as np
import pytest
from eitbench.bench.methods import baseline_folder
from eitbench.data.episodes import simulate, truth_discretisation
from eitbench.data.seeds import parse_seeds
from eitbench.estimation import (
    InflowFilter,
    InflowPrior,
    Observation,
    changing_responses,
    fit_inflow_prior,
    learned_inflow_prior,
    most_probable_inflow,
    smoothed_inflow,
    suiting_priors,
)
from eitbench.worlds.catalogue import PIPE_2D_OBSTACLE
from eitbench.worlds.catalogue import ROTATING_TANK_2D as ROTATING_TANK
from eitbench.worlds.catalogue import STATIONARY_TANK_2D as STATIONARY_TANK
from eitbench.worlds.task import make_task
from models import tiny_task as task
from models import two_modes, white_inflow
from scipy.linalg import toeplitz

from tiny_worlds import TINY

LEVEL = 29.0


@lru_cache(maxsize=2)
def prior(link="logarithm"):
    """Two modes across the inlet, a correlation over four steps."""
    return two_modes(task().mesh.points[task().transport.inlet], task().transport.time_step, link)


def record(seed=0):
    """(voltages, currents) of five injections."""
    episode = simulate(TINY, seed)
    cycle = TINY.currents
    currents = [cycle[t % len(cycle)] for t in range(TINY.n_steps)]
    return [(episode.voltages(t + 1, I, TINY), I) for t, I in enumerate(currents)]


def moved(filter_, seed=1):
    """The filter with other inflows than the expected ones."""
    filter_.mean = 0.5 * np.random.default_rng(seed).standard_normal(filter_.mean.shape)
    return filter_


def stepped(inflow, lag=0):
    """The concentration that the transport makes of inflows (W, n_inlet), the newest first."""
    transport = task().transport
    deviation = np.zeros(task().mesh.n_nodes)
    nothing = np.zeros(len(transport.inlet))
    before = nothing
    for after in inflow[lag:][::-1] - LEVEL:
        deviation = transport.step(deviation, before, after)
        before = after
    return LEVEL + deviation


def test_a_flow_that_changes_carries_each_inflow_by_what_flowed_then():
    """Inflows carried on step by step, each step by its own transport; before the first it was as in it."""
    nominal, faster = (make_task(TINY.changed({"flow": {"mean_velocity": speed}})).transport for speed in (45.0, 60.0))
    transports = [nominal, faster, nominal]
    response = changing_responses(lambda t: transports[t - 1], 3)[-1]
    K, inlet = response.weights.shape[1:]
    inflow = 1.0 + 0.3 * np.random.default_rng(5).standard_normal((K + 2, inlet))        # the oldest first
    state, before = np.zeros(task().mesh.n_nodes), np.zeros(inlet)
    for k, after in enumerate(inflow):
        state = transports[max(k - K + 1, 0)].step(state, before, after)
        before = after
    made = response.basis @ np.tensordot(response.weights, inflow[::-1][:K], 2)
    assert np.linalg.norm(made - state) < 0.02 * np.linalg.norm(state)                   # 0.01 is forgotten


@pytest.mark.parametrize("link", ["linear", "logarithm"])
@pytest.mark.parametrize("lag", [0, 2])
def test_the_history_makes_what_the_flow_makes_of_it(link, lag):
    """Inflows carried on step by step by the transport: to 3e-3 of what they change, the part that is dropped."""
    filter_ = moved(InflowFilter(task(), prior(link), LEVEL, lag))
    u = filter_.mean[:lag + filter_.memory] @ prior(link).modes.T
    expected = stepped(LEVEL * (np.exp(u) if link == "logarithm" else 1.0 + u), lag)
    off = filter_.concentration(lag) - expected
    assert np.linalg.norm(off) < 3e-3 * np.linalg.norm(expected - LEVEL)


@pytest.mark.parametrize("link", ["linear", "logarithm"])
def test_derivatives_are_those_of_the_concentration(link):
    """By each of the last inflows, by central differences."""
    filter_ = moved(InflowFilter(task(), prior(link), LEVEL, 1))
    slope = filter_.by_inflow(np.eye(task().mesh.n_nodes)[::40], lag=1)
    base = filter_.mean.copy()
    for k in (0, 1, filter_.memory - 1):
        for mode in (0, 1):
            sides = []
            for sign in (1.0, -1.0):
                filter_.mean = base.copy()
                filter_.mean[1 + k, mode] += sign * 1e-4
                sides.append(filter_.concentration(1)[::40])
            difference = (sides[0] - sides[1]) / 2e-4
            np.testing.assert_allclose(slope[:, 2 * k + mode], difference, atol=1e-6 * LEVEL)


def dense(filter_, observations, times):
    """Mean and covariance of the concentration at each of ``times``, given all observations: one Gaussian of the whole
    history, conditioned at once."""
    T = len(observations)
    K, r = filter_.memory, filter_.mean.shape[1]
    covariance = np.kron(toeplitz(filter_.prior.time_covariance(T + K - 1)), np.eye(r))
    basis, weights = filter_.response()
    part = (LEVEL * basis @ (weights @ filter_.prior.modes).reshape(len(weights), -1))  # (n, K·r)
    G = np.zeros((T, len(part), (T + K - 1) * r))
    for t in range(T):                                                                  # the newest first
        G[t][:, (T - 1 - t) * r:(T - 1 - t + K) * r] = part
    H = np.concatenate([o.matrix @ G[t] for t, o in enumerate(observations)])
    y = np.concatenate([o.value - LEVEL * o.matrix.sum(axis=1) for o in observations])
    S = H @ covariance @ H.T + np.diag(np.concatenate([o.noise_variance for o in observations]))
    gain = np.linalg.solve(S, H @ covariance).T
    mean, rest = gain @ y, covariance - gain @ H @ covariance
    return [(LEVEL + G[t - 1] @ mean, np.einsum("ij,jk,ik->i", G[t - 1], rest, G[t - 1])) for t in times]


def some_observations(count=5):
    rng = np.random.default_rng(5)
    n = task().mesh.n_nodes
    noise = np.array([0.01, 0.02, 0.1])
    return [Observation(rng.normal(size=(3, n)) / n, LEVEL + 0.3 * rng.normal(size=3), noise) for _ in range(count)]


@pytest.mark.parametrize("lag", [0, 3])
def test_filter_is_gaussian_conditioning(lag):
    """Five linear measurements, each of the present state: mean and variance of the state ``lag`` steps before the last
    as one Gaussian conditioned at once has them. Without a lag what the filter has forgotten still tells it a little of
    what it has not: 1e-4."""
    filter_ = InflowFilter(task(), prior("linear"), LEVEL, lag)
    observations = some_observations()
    for observation in observations:
        filter_.predict()
        filter_.take_in(observation, filter_.concentration())
    ((mean, variance),) = dense(filter_, observations, [5 - lag])
    state = filter_.state(lag)
    tolerance = 1e-8 if lag else 1e-4
    np.testing.assert_allclose(state.mean, mean, atol=tolerance * LEVEL)
    np.testing.assert_allclose(state.variance, variance, atol=tolerance * variance.max())


def test_white_inflow_is_table_5_1():
    """Before anything is measured the variances are those of the white inflow, Σ FᵏYYᵀFᵏᵀ, to what the pipe forgets."""
    filter_ = InflowFilter(task(), white_inflow(task()), LEVEL)
    filter_.predict()
    F, Y = task().transport.transition()
    expected = np.zeros(len(F))
    part = task().prior.inflow_std * LEVEL * Y
    for _ in range(40):
        expected += (part**2).sum(axis=1)
        part = F @ part
    np.testing.assert_allclose(filter_.state().variance, expected, atol=2e-3 * expected.max())


def test_prediction_keeps_the_prior():
    """Where nothing is measured, mean and covariance stay those of a stationary process."""
    filter_ = InflowFilter(task(), prior(), LEVEL)
    before = filter_.covariance.copy()
    for _ in range(30):
        filter_.predict()
    np.testing.assert_allclose(filter_.covariance, before, atol=1e-10)
    assert not filter_.mean.any()


@lru_cache(maxsize=1)
def most_probable():
    smoother = smoothed_inflow(task(), prior(), LEVEL, record())
    first = smoother.mean.copy()
    most_probable_inflow(smoother, record())
    return smoother, first


def density(smoother, x, std):
    """−2 ln of the posterior density, from its parts."""
    smoother.mean = x
    precision = np.linalg.inv(toeplitz(prior().time_covariance(smoother.window)))
    value = np.einsum("ik,ij,jk->", x, precision, x)
    for t, (voltages, currents) in enumerate(record()):
        there = task().observation.voltages(smoother.concentration(len(record()) - 1 - t), currents[None])[0]
        value += (((voltages - there) / std[t])**2).sum()
    return value


def test_nothing_is_more_probable():
    """Twenty steps in any direction, ahead and back, lead to a lower density, and so has the smoothed history."""
    smoother, first = most_probable()
    best = smoother.mean.copy()
    smoother.mean = first
    std = [task().noise.std(task().observation.voltages(smoother.concentration(len(record()) - 1 - t), I[None])[0])
           for t, (_, I) in enumerate(record())]
    least = density(smoother, best, std)
    assert least < density(smoother, first, std)
    random = np.random.default_rng(2)
    for _ in range(20):
        step = 0.05 * random.standard_normal(best.shape)
        assert density(smoother, best + step, std) > least
        assert density(smoother, best - step, std) > least
    smoother.mean = best


def test_learns_the_law_of_what_it_is_shown():
    """u = E x with x autoregressive, ρ = 0.7: Γ_across and the correlation of the next steps come out, the closer the
    more episodes there are."""
    random = np.random.default_rng(4)
    E = np.array([[0.2, 0.0], [0.15, 0.1], [0.0, 0.2]])
    off = []
    for episodes in (5, 2000):
        x = np.zeros((episodes, 100, 2))
        x[:, 0] = random.standard_normal((episodes, 2))
        for t in range(1, 100):
            x[:, t] = 0.7 * x[:, t - 1] + np.sqrt(1 - 0.7**2) * random.standard_normal((episodes, 2))
        learned = fit_inflow_prior(np.exp(x @ E.T), np.zeros((3, 2)), 0.005, nugget=0.0)
        off.append(np.abs(learned.modes @ learned.modes.T - E @ E.T).max() / (E @ E.T).max())
        np.testing.assert_allclose(learned.correlation[:4], 0.7**np.arange(4), atol=0.1)
    assert off[1] < 0.02 and off[1] < off[0] / 3


def test_a_correlation_is_one():
    """Whatever the sample, the covariance in time has no negative eigenvalue."""
    random = np.random.default_rng(6)
    for _ in range(20):
        ratios = np.exp(0.1 * random.standard_normal((2, 30, 3)).cumsum(axis=1))
        learned = fit_inflow_prior(ratios, np.zeros((3, 2)), 0.01)
        values = np.linalg.eigvalsh(toeplitz(learned.time_covariance(60)))
        assert values.min() > -1e-9


def test_inflows_are_those_of_the_simulation():
    """At the truth's inlet, where its nodes are the model's too."""
    sampled = TINY.sample_inflow(3)
    assert sampled.shape == (TINY.lead_in + TINY.n_steps + 1, 21)
    truth = truth_discretisation(TINY).transport
    fine = truth.mesh.points[truth.inlet][:, 1]
    coarse = task().mesh.points[task().transport.inlet][:, 1]
    same = [(i, k) for i, y in enumerate(coarse) for k, z in enumerate(fine) if abs(y - z) < 1e-9]
    assert len(same) > 5
    here, there = map(list, zip(*same, strict=True))
    simulated = simulate(TINY, 3).concentration[:, truth.inlet]
    np.testing.assert_allclose(sampled[TINY.lead_in:, here], simulated[:, there], rtol=1e-6)


def test_learns_from_train_alone():
    with pytest.raises(ValueError, match=r"seeds must be of the split train.*dev:0"):
        learned_inflow_prior(TINY, parse_seeds("dev:0-3"))
    with pytest.raises(ValueError, match="target must have an inflow, got"):
        learned_inflow_prior(STATIONARY_TANK, [0])


def test_a_file_says_all(tmp_path):
    prior().save(tmp_path / "a.json")
    again = InflowPrior.load(tmp_path / "a.json")
    np.testing.assert_allclose(again.modes, prior().modes, rtol=1e-8)
    np.testing.assert_allclose(again.correlation, prior().correlation, rtol=1e-8)
    assert (again.link, again.time_step) == ("logarithm", prior().time_step)
    assert suiting_priors(tmp_path, task(), "logarithm")
    assert not suiting_priors(tmp_path, task(), "linear")
    assert not suiting_priors(tmp_path, make_task(ROTATING_TANK), "logarithm")


def test_an_inlet_that_hardly_differs_is_the_same():
    """Behind the obstacle's inlet, whose nodes lie nanometres beside the straight pipe's; not those of half a pipe."""
    shipped = InflowPrior.load(baseline_folder() / "priors" / "pipe2d-logarithm.json")
    assert shipped.suits(make_task(PIPE_2D_OBSTACLE))
    narrow = TINY.changed({"vessel": {"half_width": 0.04}})
    assert not shipped.suits(make_task(narrow))


@pytest.mark.parametrize("text", ["", "[]", "{", '{"link": "linear"}', '{"link": 3}'])
def test_other_files_are_told(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(ValueError, match=r"a\.json must be a prior of `eitbench fit prior`"):
        InflowPrior.load(tmp_path / "a.json")


def test_what_does_not_fit_is_told():
    with pytest.raises(ValueError, match=r"the prior must be of the task's inlet, 0 nodes"):
        InflowFilter(make_task(ROTATING_TANK), prior(), LEVEL)
    with pytest.raises(ValueError, match="link must be one of linear, logarithm, got 'log'"):
        InflowPrior("log", prior().points, prior().modes, prior().correlation, 0.005)
    with pytest.raises(ValueError, match="correlation must begin with 1"):
        InflowPrior("linear", prior().points, prior().modes, np.array([0.9, 0.1]), 0.005)
    with pytest.raises(ValueError, match="ratios must be above 0, got -1"):
        fit_inflow_prior(np.full((1, 40, 3), -1.0), np.zeros((3, 2)), 0.005)
    with pytest.raises(ValueError, match="ratios must change"):
        fit_inflow_prior(np.ones((1, 40, 3)), np.zeros((3, 2)), 0.005)
