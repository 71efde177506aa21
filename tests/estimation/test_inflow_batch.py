"""Filters of many episodes side by side: against the filter that takes them one by one."""

import numpy as np
import pytest
from eitbench.estimation import InflowBatch, InflowFilter, InflowPrior, Response, steady_response
from eitbench.worlds.task import make_task

from tiny_worlds import TINY

LEVELS = np.array([27.0, 30.0, 34.0])
STEPS = 24


@pytest.fixture(scope="module")
def task():
    return make_task(TINY)


def prior(task, link):
    points = task.mesh.points[task.transport.inlet]
    r = points[:, 1] / 0.05
    return InflowPrior(link, points, 0.2 * np.stack([np.exp(-r**2), r], axis=1), 0.6**np.arange(5)**2.0,
                       task.transport.time_step)


def readings(task, seed=0):
    """(STEPS, B, L) V of fluids that jump from step to step, and the currents (STEPS, L)."""
    random = np.random.default_rng(seed)
    currents = task.currents[np.arange(STEPS) % len(task.currents)]
    states = LEVELS * np.exp(0.03 * random.normal(size=(STEPS, len(LEVELS))))
    n = task.mesh.n_nodes
    return np.array([[task.observation.voltages(np.full(n, c), each[None])[0] for c in row]
                     for row, each in zip(states, currents, strict=True)]), currents


def same(found, expected):
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("link", ["logarithm", "linear"])
@pytest.mark.parametrize("lag", [0, 3])
def test_it_is_the_filter_of_each_episode(task, link, lag):
    """Means, covariances, innovations and states, at the first steps and after the window has gone round."""
    believed = prior(task, link)
    batch = InflowBatch(task, believed, LEVELS, lag)
    singles = [InflowFilter(task, believed, level, lag) for level in LEVELS]
    assert batch.window < STEPS
    voltages, currents = readings(task)
    for each, injected in zip(voltages, currents, strict=True):
        batch.predict()
        told = batch.update(each, injected)
        for b, single in enumerate(singles):
            single.predict()
            value, covariance = single.update(each[b], injected)
            same(told.value[b], value)
            same(told.covariance[b], covariance)
            same(batch.mean[b], single.mean)
            same(batch.covariance[b], single.covariance)
            state = single.state(lag)
            same(batch.concentration(lag)[b], state.mean)
            same(batch.variance(lag)[b], state.variance)


def test_modes_are_coordinates_in_the_basis(task):
    basis, weights = steady_response(task.transport)
    batch = InflowBatch(task, prior(task, "logarithm"), LEVELS, response=Response(basis[:, -5:], weights[-5:]))
    voltages, currents = readings(task)
    batch.predict()
    batch.update(voltages[0], currents[0])
    deviation = batch.concentration() / LEVELS[:, None] - 1.0
    np.testing.assert_allclose(batch.modes(), deviation @ basis[:, -5:], atol=1e-12)
    assert np.abs(batch.modes()).max() > 1e-3


def test_mistakes(task):
    believed = prior(task, "logarithm")
    with pytest.raises(ValueError, match="levels must"):
        InflowBatch(task, believed, np.ones((2, 2)))
    with pytest.raises(ValueError, match="lag must be"):
        InflowBatch(task, believed, LEVELS, -1)
    batch = InflowBatch(task, believed, LEVELS)
    batch.predict()
    with pytest.raises(ValueError, match="voltages must have shape"):
        batch.update(np.zeros((2, 4)), task.currents[0])
