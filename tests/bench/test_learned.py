"""What is learned is what is played: numpy's network is torch's, and it plays what it was trained for alone."""

from pathlib import Path

import eitbench
import numpy as np
import pytest
import torch
from eitbench.bench.methods import load_method, load_module
from eitbench.estimation import FirstFrame
from eitbench.worlds import entry
from eitbench.worlds.task import make_task

from tiny_worlds import CHANGES

STUDY = Path(__file__).parents[2] / "studies" / "learn_correction.py"
ID = "eitbench/Pipe2DBiasedVelocity-v0"


@pytest.fixture(scope="module")
def study():
    return load_module("study", STUDY, STUDY.read_bytes())


@pytest.fixture
def data():
    """Three episodes of ten steps, in which a filter is off by a multiple of what is seen."""
    random = torch.Generator().manual_seed(0)
    inputs = torch.randn(3, 10, 7, generator=random)
    truth = 0.3 * inputs[..., :2] - 0.1 * inputs[..., 2:4]
    one = torch.ones(3, 10)
    return {"inputs": inputs, "reduced": torch.zeros(3, 10, 2), "truth": truth, "weight": one, "rest": 0.0 * one,
            "velocity": torch.zeros(3, 1)}


def test_numpy_answers_as_torch(study):
    """Of the same weights, which half precision holds, over an episode."""
    torch.manual_seed(1)
    network = study.Correction(0.5 + torch.rand(7), 0.5 + torch.rand(3))
    torch.nn.init.normal_(network.output.weight, std=0.1)
    network = network.half().double().eval()
    arrays = {name: each.astype(float) for name, each in network.arrays().items()}
    inputs = np.random.default_rng(0).normal(size=(20, 7))
    with torch.no_grad():
        correction, log_variance, _ = network(torch.tensor(inputs)[None])
    scale = network.output_scale
    memory = np.zeros(study.HIDDEN)
    for t, seen in enumerate(inputs):
        memory, said, variance = study.method.step(arrays, seen, memory)
        np.testing.assert_allclose(said, (scale * correction)[0, t], rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(variance, (scale**2 * log_variance.exp())[0, t], rtol=1e-6)


def test_a_seed_repeats_and_something_is_learned(study, data, monkeypatch):
    monkeypatch.setattr(study, "EPOCHS", 60)
    monkeypatch.setattr(study, "NOISE", 0.1)
    first, error = study.trained(data, data, 2, seed=3)
    again, same = study.trained(data, data, 2, seed=3)
    _, other = study.trained(data, data, 2, seed=4)
    assert error == same != other
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), again.parameters(), strict=True))
    assert error < 0.3 * study.filters_errors(data)[:, 2:].mean()


def test_scores_in_modes_are_scores(study):
    """An estimate in the span of the modes scores as the environment would score it."""
    examples = eitbench.dataset("eitbench/Pipe2D-v0", "train:0", world=CHANGES)
    (example,) = examples
    random = np.random.default_rng(0)
    root = np.linalg.cholesky(examples.mass.toarray())
    basis = np.linalg.solve(root.T, np.linalg.qr(random.normal(size=(len(root), 3)))[0])
    found = study.features(examples, example, basis)
    first = FirstFrame(make_task(examples.world))
    for measurement in zip(example.voltages[:first.length], example.currents, strict=False):
        first.add(*measurement)
    said = found["truth"] + 1e-3 * random.normal(size=found["truth"].shape)
    errors = found["weight"] * ((said - found["truth"])**2).sum(axis=1) + found["rest"]
    expected = examples.errors(example, first.c_bh * (1.0 + said @ basis.T))
    np.testing.assert_allclose(errors, expected, rtol=1e-6)


@pytest.mark.parametrize("changes, assumed, plays", [
    ({"schedule": {"scored_steps": 5}, "instrument": {"noise_relative": 0.02}}, {}, True),
    ({}, {"mean_velocity": 4.0}, False),
    (CHANGES, {}, False),
])
def test_it_plays_the_task_that_it_was_trained_for(changes, assumed, plays):
    """Other records of the same pipe too; no other vessel, and no other model of the flow."""
    task = make_task(entry(ID).world.changed(changes), **assumed)
    assert load_method("learned_correction", "estimation").suits(task) == plays


def test_it_does_not_play_tanks():
    task = make_task(entry("eitbench/StationaryTank2D-v0").world)
    assert not load_method("learned_correction", "estimation").suits(task)


def test_the_shipped_network_is_small():
    """Plain arrays, two megabytes at most."""
    path = Path(load_method("learned_correction", "estimation").path).parent / "networks" / "pipe2d-biased.npz"
    assert path.stat().st_size < 2e6
    with np.load(path, allow_pickle=False) as file:
        assert all(file[name].dtype.kind == "f" for name in file.files)
