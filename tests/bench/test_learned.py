"""Trained networks: the numpy implementation agrees with torch, and networks run on their training task only."""

import importlib
from dataclasses import replace
from pathlib import Path

import eitbench
import numpy as np
import pytest
import torch
from eitbench.bench.methods import load_method
from eitbench.estimation import CalibrationFrame, apply_correction, compatible_priors, gru_step, inflow_filter
from eitbench.worlds import entry
from eitbench.worlds.task import make_task

from short import FAST

ROOT = Path(__file__).parents[2]
ID = "eitbench/Pipe2DBiasedVelocity-v0"
LEARNED = ("learned_correction", "learned_smoother", "learned_fixed_lag", "learned_obstacle", "learned_voltages")


@pytest.fixture(scope="module")
def study():
    """Import `studies/learn.py` with its folder on the path."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "studies")
        return importlib.import_module("learn")


@pytest.fixture
def data():
    """Three episodes of ten steps, in which the filter error is a multiple of the inputs."""
    random = torch.Generator().manual_seed(0)
    inputs = torch.randn(3, 10, 7, generator=random)
    truth = 0.3 * inputs[..., :2] - 0.1 * inputs[..., 2:4]
    one = torch.ones(3, 10)
    return {"inputs": inputs, "reduced": torch.zeros(3, 10, 2), "truth": truth, "weight": one, "rest": 0.0 * one,
            "velocity": torch.zeros(3, 1)}


@pytest.mark.parametrize("both_ways, many", [(False, 1), (True, 1), (False, 4), (True, 4)])
def test_numpy_agrees_with_torch(study, both_ways, many):
    """Outputs agree for weights in half precision; joined networks return the mean."""
    torch.manual_seed(1)
    scales = 0.5 + torch.rand(7), 0.5 + torch.rand(3)
    networks = [study.Correction(*scales, 24, both_ways) for _ in range(many)]
    for network in networks:
        torch.nn.init.normal_(network.output.weight, std=0.1)
        network.half().double().eval()
    basis = np.random.default_rng(1).normal(size=(5, 3))
    arrays = {name: each.astype(float) for name, each in study.average_networks(networks).items()} | {
        "basis": basis, "rest": np.full(5, 0.1)}
    inputs = np.random.default_rng(0).normal(size=(20, 7))
    with torch.no_grad():
        correction, log_variance, _ = (torch.stack(each).mean(dim=0) for each in zip(
            *(network(torch.tensor(inputs)[None]) for network in networks), strict=True))
    scale = network.output_scale

    def memories(inputs, way=""):
        memory = np.zeros(24 * many)
        for seen in inputs:
            memory = gru_step(arrays, seen, memory, way)
            yield memory

    ways = [list(memories(inputs))]
    if both_ways:
        ways.append(list(memories(inputs[::-1], "backward_"))[::-1])
    tolerance = 1e-6 if many == 1 else 2e-3  # means of biases are rounded again
    for t, memory in enumerate(np.concatenate(ways, axis=1)):
        mean, variance = apply_correction(arrays, 2.0, np.ones(3), inputs[t], memory)[:2]
        expected = 2.0 * (1.0 + basis @ (1.0 + (scale * correction)[0, t].numpy()))
        spread = 4.0 * (basis**2 @ (scale**2 * log_variance.exp())[0, t].numpy() + 0.1)
        np.testing.assert_allclose(mean, expected, rtol=tolerance, atol=1e-3 * tolerance)
        np.testing.assert_allclose(variance, spread, rtol=tolerance)


@pytest.mark.parametrize("likelihood", ["modes", "nodes"])
def test_a_seed_repeats_and_something_is_learned(study, data, likelihood):
    setup = replace(study.SETUPS["obstacle"], noise=0.1)
    modes = () if likelihood == "modes" else (np.eye(2), np.full(2, 1e-6))
    loss = study.Loss(2, *modes)
    first, error = study.train(setup, data, data, loss, seed=3, epochs=60)
    again, same = study.train(setup, data, data, loss, seed=3, epochs=60)
    _, other = study.train(setup, data, data, loss, seed=4, epochs=60)
    assert error == same != other
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), again.parameters(), strict=True))
    assert error < 0.3 * study.filter_errors(data)[:, 2:].mean()


@pytest.fixture(scope="module")
def short(study):
    """A short episode, three modes, and the data that training stores."""
    examples = eitbench.dataset("eitbench/Pipe2D-v0", "train:0", world=FAST)
    (example,) = examples
    random = np.random.default_rng(0)
    root = np.linalg.cholesky(examples.mass.toarray())
    basis = np.linalg.solve(root.T, np.linalg.qr(random.normal(size=(len(root), 3)))[0])
    first = CalibrationFrame(make_task(examples.world))
    for measurement in zip(example.voltages[:first.length], example.currents, strict=False):
        first.add(*measurement)
    return examples, example, basis, first.c_ref


def test_scores_in_modes_are_scores(study, short):
    """An estimate in the span of the modes has the same score as in the environment."""
    examples, example, basis, level = short
    found = study.features(examples, example, basis)
    said = found["truth"] + 1e-3 * np.random.default_rng(0).normal(size=found["truth"].shape)
    errors = found["weight"] * ((said - found["truth"])**2).sum(axis=1) + found["rest"]
    expected = examples.errors(example, level * (1.0 + said @ basis.T))
    np.testing.assert_allclose(errors, expected, rtol=1e-6)


def test_lagged_modes_are_of_the_same_state(study, short, monkeypatch):
    """At each step the modes are of the filter's state ``lag`` steps before, also at the end of the episode."""
    examples, example, basis, level = short
    monkeypatch.setattr(study, "LAGS", (2,))
    found = study.features(examples, example, basis)
    task = make_task(examples.world)
    prior = compatible_priors(ROOT / "baselines" / "priors", task, "logarithm")[0]
    filter = inflow_filter(task, prior, level, lag=2)
    modes = np.linalg.pinv(basis)
    T = len(example.voltages)
    for t, measurement in enumerate(zip(example.voltages, example.currents, strict=True)):
        filter.assimilate(*measurement)
        for state in [t - 2] if t < T - 1 else range(T - 3, T):
            if state >= 0:
                np.testing.assert_allclose(found["reduced 2"][state],
                                           modes @ (filter.estimate(t - state).mean / level - 1.0), rtol=1e-10)
    setup = replace(study.SETUPS["lag"], lag=2)
    seen = study.select_lag(setup, found)
    np.testing.assert_array_equal(seen["truth"], found["truth"][:-2])
    np.testing.assert_array_equal(seen["inputs"], np.concatenate([found["inputs"][2:], seen["reduced"]], axis=1))


@pytest.mark.parametrize(("id", "changes", "arguments", "suitable", "unsuitable"), [
    # episodes of other lengths are accepted; other vessels, lags and flow models are rejected
    (ID, {"schedule": {"scored_steps": 5}, "instrument": {"noise_relative": 0.02}}, {}, {"learned_correction"}, set()),
    (ID, {}, {"mean_velocity": 4.0}, set(), {"learned_correction"}), (ID, FAST, {}, set(), {"learned_correction"}),
    ("eitbench/Pipe2DSmoothing-v0", {}, {}, {"learned_smoother"}, {"learned_obstacle"}),
    ("eitbench/Pipe2DFixedLag-v0", {}, {"lag": 3}, set(), {"learned_fixed_lag"}),
    ("eitbench/StationaryTank2D-v0", {}, {}, set(), set(LEARNED))])
def test_networks_are_compatible_with_their_training_task(id, changes, arguments, suitable, unsuitable):
    task = make_task(entry(id).world.with_changes(changes), **dict(entry(id).settings) | arguments)
    found = {name for name in suitable | unsuitable if load_method(name, "estimation").suits(task)}
    assert found == suitable
