"""The filters inside injection environments are the Kalman filters of the baselines."""

import numpy as np
import pytest
from eitbench import make_task
from eitbench.data import cache
from eitbench.data.cache import CACHE_VARIABLE
from eitbench.data.recordings import cycle_voltages, recording
from eitbench.estimation import FirstFrame, LinearisedObservations, kalman_filter, table_5_1
from eitbench.estimation.onboard import reduced_operator
from eitbench.estimation.onboard.operator import electrode_pairs
from eitbench.estimation.reduced import ReducedModel
from eitbench.worlds import entry

from choosing import NAME, filter_of, make, some_pairs

PAIRS = electrode_pairs(16).tolist()


def number(currents: np.ndarray) -> int:
    """The action that injects these currents of a pair."""
    return PAIRS.index([int(currents.argmax()), int(currents.argmin())])


def test_grid_shows_the_estimate():
    """Patch means are averages of the nodal estimate, whose spread is positive and shrinks below
    the prior's."""
    env = make("reduced")
    base = env.unwrapped
    first, _ = env.reset(seed=3)
    for action in some_pairs()[:3]:
        observation = env.step(int(action))[0]
    x, y = base.task.mesh.points.T
    mean = base.core.estimate()[0][0]
    for row, column in ((0, 0), (1, 5), (2, 11)):
        inside = ((x >= 0.4 * column / 12) & (x <= 0.4 * (column + 1) / 12)
                  & (y >= -0.05 + row / 30) & (y <= -0.05 + (row + 1) / 30))
        shown = observation["mean"][row * 12 + column]
        assert mean[inside].min() <= shown <= mean[inside].max()
        limit = 0.5 * np.ptp(mean[inside]) + 0.02
        assert shown == pytest.approx(mean[inside].mean(), abs=limit)
    assert (observation["std"] > 0).all()
    assert (observation["std"] < 0.25 * 30).all()
    assert first["std"].shape == (36,)


def test_reduced_one_is_close_to_the_baselines():
    """On the world's own cycle it comes within 1 mol/m³ (rms) of the full filter's estimate at
    every scored step."""
    env = make("reduced")
    world = env.unwrapped.world
    task = make_task(world)
    voltages = cycle_voltages(world, 5, recording(world, 5))
    first = FirstFrame(task)
    for k in range(16):
        first.add(voltages[k], world.currents[k])
    start = table_5_1(task.transport, task.prior, first.c_bh)
    linear = LinearisedObservations(task.observation, task.noise, start.mean)
    full = kalman_filter(start, [linear(v, world.currents[t % 16]) for t, v in enumerate(voltages)])
    env.reset(seed=5)
    core = env.unwrapped.core
    assert filter_of(env).concentration[0] == pytest.approx(first.c_bh, rel=0.011)
    for t in range(16, world.n_steps):
        env.step(number(world.currents[t % 16]))
        difference = core.estimate()[0][0] - full[t].mean
        told = np.abs(full[t].mean - first.c_bh).max()
        assert np.sqrt((difference**2).mean()) < 1.0 < told


def test_full_one_is_that_of_the_baselines():
    """On the world's own cycle: the same as `kalman_filter` about the same level, to 1e-7 of a
    std."""
    env = make("full")
    world = env.unwrapped.world
    task = env.unwrapped.task
    core = env.unwrapped.core
    voltages = cycle_voltages(world, 5, recording(world, 5))
    env.reset(seed=5)
    start = table_5_1(task.transport, task.prior, filter_of(env).concentration[0])
    linear = LinearisedObservations(task.observation, task.noise, start.mean)
    steps = kalman_filter(start, [linear(v, world.currents[t % 16])
                                  for t, v in enumerate(voltages)])
    for t in range(16, world.n_steps):
        env.step(number(world.currents[t % 16]))
        means, spreads = core.estimate()
        std = np.sqrt(np.maximum(steps[t].variance, 1e-12))
        assert np.abs((means[0] - steps[t].mean) / std).max() < 1e-6
        np.testing.assert_allclose(spreads[0]**2, steps[t].variance, rtol=1e-6, atol=1e-10)


def test_grid_of_the_full_one_is_that_of_its_covariance():
    """Patch spreads are those of the patch averages under the exact covariance, seen through unit
    vectors."""
    env = make("full")
    env.reset(seed=5)
    shown = env.step(7)[0]["std"]
    operator = filter_of(env)
    filter_, averages = operator._filters[0], operator._patches
    unit = np.eye(averages.shape[1])
    covariance = filter_.covariance.apply(filter_.time, unit) - filter_.known @ filter_.known.T
    variance = np.einsum("pn,nm,pm->p", averages, covariance, averages)
    expected = operator.concentration[0] * np.sqrt(variance)
    np.testing.assert_allclose(shown, expected, rtol=1e-8)


def test_stored_reduced_model_is_kept_and_damage_is_noticed(monkeypatch, tmp_path):
    """Made once, read after that, to the bit; a damaged file is made anew."""
    made = []
    world = entry(NAME).world
    rng = np.random.default_rng(0)
    covariances = np.einsum("kij,klj->kil", *[rng.integers(-5, 5, size=(2, 3, 3)).astype(float)] * 2)
    model = ReducedModel(*(rng.integers(-9, 9, size=(n, 3)) / 8.0 for n in (9, 3)), *covariances)
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    monkeypatch.setattr(cache, "PACKAGE_DATA", tmp_path / "none")
    monkeypatch.setattr(reduced_operator, "make_model", lambda of: made.append(of) or model)
    for _ in range(2):
        stored = reduced_operator._stored_model(world)
        assert all((a == b).all() for a, b in zip(stored, model, strict=True))
    assert len(made) == 1
    path, = tmp_path.rglob("reduced-*.npy")
    data = path.read_bytes()
    for damaged in (data[:-9], data[:200] + bytes([data[200] ^ 1]) + data[201:], b""):
        path.write_bytes(damaged)
        stored = reduced_operator._stored_model(world)
        assert all((a == b).all() for a, b in zip(stored, model, strict=True))
    assert len(made) == 4


def test_worlds_that_differ_in_what_is_broken_share_their_model(monkeypatch, tmp_path):
    """Faults, floors, limits and budgets are none of the filter's; noise and what is believed
    are."""
    made = []
    model = ReducedModel(np.ones((9, 3)), *np.ones((3, 3, 3)))
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    monkeypatch.setattr(cache, "PACKAGE_DATA", tmp_path / "none")
    monkeypatch.setattr(reduced_operator, "make_model", lambda of: made.append(of) or model)
    world = entry(NAME).world
    same = [{"instrument": {"noise_floor": 1e-3, "limit": "L2"}}, {"instrument": {"dead": [1, 2]}},
            {"schedule": {"budget": 5}}, {}]
    for change in same:
        reduced_operator._stored_model(world.changed(change))
    assert len(made) == 1
    for change in ({"instrument": {"noise_relative": 0.02}}, {"prior": {"nodal_std": 0.1}}):
        reduced_operator._stored_model(world.changed(change))
    assert len(made) == 3
