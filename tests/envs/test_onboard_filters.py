"""The filters inside injection environments are the Kalman filters of the baselines."""

import numpy as np
import pytest
from eitbench import make_task
from eitbench.data.episode_cache import cached_episode, cycle_voltages
from eitbench.estimation import CalibrationFrame, LinearisedForwardModel, kalman_filter, table_5_1_filter
from eitbench.estimation.onboard.linearisation import electrode_pairs

from injection_envs import filter_of, make

PAIRS = electrode_pairs(16).tolist()


def number(currents: np.ndarray) -> int:
    """Return the action that injects these currents of a pair."""
    return PAIRS.index([int(currents.argmax()), int(currents.argmin())])


def test_reduced_one_is_close_to_the_baselines():
    """On the world's cycle it is within 1 mol/m³ (RMS) of the full filter's estimate at every scored step."""
    env = make("reduced")
    world = env.unwrapped.world
    task = make_task(world)
    voltages = cycle_voltages(world, 5, cached_episode(world, 5))
    first = CalibrationFrame(task)
    for k in range(16):
        first.add(voltages[k], world.currents[k])
    start = table_5_1_filter(task.transport, task.prior, first.c_ref)
    linear = LinearisedForwardModel(task.observation, task.noise, start.mean)
    full = kalman_filter(start, [linear(v, world.currents[t % 16]) for t, v in enumerate(voltages)])
    env.reset(seed=5)
    core = env.unwrapped.core
    assert filter_of(env).c_ref[0] == pytest.approx(first.c_ref, rel=0.011)
    for t in range(16, world.n_steps):
        env.step(number(world.currents[t % 16]))
        difference = core.estimate()[0][0] - full[t].mean
        told = np.abs(full[t].mean - first.c_ref).max()
        assert np.sqrt((difference**2).mean()) < 1.0 < told


def test_full_one_is_that_of_the_baselines():
    """On the world's cycle it equals `kalman_filter` about the same c_ref, to 1e-7 of a std."""
    env = make("full")
    world = env.unwrapped.world
    task = env.unwrapped.task
    core = env.unwrapped.core
    voltages = cycle_voltages(world, 5, cached_episode(world, 5))
    env.reset(seed=5)
    start = table_5_1_filter(task.transport, task.prior, filter_of(env).c_ref[0])
    linear = LinearisedForwardModel(task.observation, task.noise, start.mean)
    steps = kalman_filter(start, [linear(v, world.currents[t % 16]) for t, v in enumerate(voltages)])
    for t in range(16, world.n_steps):
        env.step(number(world.currents[t % 16]))
        means, spreads = core.estimate()
        std = np.sqrt(np.maximum(steps[t].variance, 1e-12))
        assert np.abs((means[0] - steps[t].mean) / std).max() < 1e-6
        np.testing.assert_allclose(spreads[0]**2, steps[t].variance, rtol=1e-6, atol=1e-10)


def test_grid_of_the_full_one_is_that_of_its_covariance():
    """Standard deviations of the grid equal patch averages under the full covariance."""
    env = make("full")
    env.reset(seed=5)
    shown = env.step(7)[0]["std"]
    operator = filter_of(env)
    filter_, averages = operator._filters[0], operator.table.grid_averages
    unit = np.eye(averages.shape[1])
    covariance = filter_.covariance.times(unit)
    variance = np.einsum("pn,nm,pm->p", averages, covariance, averages)
    expected = operator.c_ref[0] * np.sqrt(variance)
    np.testing.assert_allclose(shown, expected, rtol=1e-8)
