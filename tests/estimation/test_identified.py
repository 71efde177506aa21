"""Identified models are compared with unseen episodes, and filters with them with dense
formulas."""

import copy
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from eitbench.data.dataset import Dataset
from eitbench.data.seeds import parse_seeds
from eitbench.estimation import (
    CalibrationFrame,
    IdentifiedModel,
    QuadraticVoltageModel,
    compatible_models,
    full_window_filter,
    identify_model,
    inflow_filter,
    linearise_voltages,
    map_inflow,
    maximise_posterior,
    steady_response,
)
from eitbench.worlds.catalogue import PIPE_2D
from eitbench.worlds.task import make_task
from models import by_window
from models import tiny_prior as prior
from models import tiny_task as task

from short import TINY

LEVEL = 29.0


def examples(seeds):
    return Dataset("tiny", TINY, tuple(parse_seeds(seeds)))


@lru_cache(maxsize=1)
def model():
    return identify_model(examples("train:0-23"), modes=24)


def made(response, seed):
    """Return the states (T, n) of an episode, relative to the background, less 1, from a response to its inflows."""
    s = TINY.sample_inflow(seed) / TINY.background - 1.0
    K = response.weights.shape[1]
    s = np.concatenate([np.zeros((K, s.shape[1])), s])
    end = len(s) - TINY.n_steps
    past = [s[end + t:end + t - K:-1] for t in range(TINY.n_steps)]
    return np.array([response.basis @ np.tensordot(response.weights, each, 2) for each in past])


def square_errors(responses):
    """Return the mean square error of the states of unseen episodes for each response."""
    mass, off = examples("train:0").mass, dict.fromkeys(responses, 0.0)
    for example in examples("train:40-47"):
        truth = example.truth / TINY.background - 1.0
        for name, response in responses.items():
            error = made(response, example.seed) - truth
            off[name] += np.einsum("tn,nt->t", error, mass @ error.T).mean() / 8
    return off


def test_predicts_states_of_unseen_episodes():
    """The mean square error of identified responses matches their covariance. A full fit to 24
    episodes has at most a tenth of the error with a too low velocity. A residual fit to eight has a
    smaller error than the task's flow, and a much smaller error than a full fit; with 24 it is
    below six tenths."""
    corrected = identify_model(examples("train:0-23"), modes=24, residual_only=True)
    few = [identify_model(examples("train:0-7"), modes=24, residual_only=residual_only).response
           for residual_only in (True, False)]
    slow = steady_response(make_task(TINY, mean_velocity=36.0).transport)
    off = square_errors({"full 24": model().response, "slow": slow,
                         "task": steady_response(task().transport), "full 8": few[1],
                         "residual 24": corrected.response, "residual 8": few[0]})
    assert off["full 24"] < 0.1 * off["slow"]
    assert off["residual 8"] < off["task"] < 0.5 * off["full 8"]
    assert off["residual 24"] < 0.6 * off["task"]
    assert 0.5 < off["full 24"] / model().residual_covariance.trace() < 6.0
    assert 0.5 < off["residual 24"] / corrected.residual_covariance.trace() < 6.0


def test_mean_voltage_error():
    """On unseen episodes the corrected voltage errors have zero mean, within the statistical error."""
    left = []
    for example in examples("train:40-47"):
        for voltages, currents, truth in zip(example.voltages, example.currents, example.truth, strict=True):
            computed = task().observation.voltages(truth.astype(float), currents[None])[0]
            std = task().noise.std(computed)
            left.append((voltages - computed - model().mean_error(currents, std)) / std)
    left = np.array(left)
    assert np.abs(left.mean(axis=0)).max() < 4.5 / np.sqrt(len(left))
    assert (left**2).mean() < 1.5
    strange = np.arange(4.0)
    assert not model().mean_error(strange, np.ones(4)).any()


@lru_cache(maxsize=1)
def once():
    """Return the model with voltages linearised once."""
    return identify_model(examples("train:0-23"), modes=24, linearised=True)


def test_covariance_of_linearised_voltages():
    """On unseen episodes, measured minus linearised voltages at the true states have zero mean and the model's
    covariance: whitened, their mean square is 1 to a tenth. The noise alone is smaller."""
    whitened, in_noise = [], []
    for example in examples("train:40-55"):
        first = CalibrationFrame(task())
        for t in range(first.length):
            first.add(example.voltages[t], example.currents[t])
        for voltages, currents, truth in zip(example.voltages, example.currents, example.truth, strict=True):
            at = linearise_voltages(task().observation, task().noise, first.mean, voltages, currents)
            std = np.sqrt(at.noise_variance)
            off = at.value - at.matrix @ truth.astype(float) - once().mean_error(currents, std)
            whitened.append(np.linalg.solve(once().error_root(currents, std), off))
            in_noise.append(off / std)
    assert np.abs(np.mean(whitened, axis=0)).max() < 4.5 / np.sqrt(len(whitened))
    assert 0.8 < np.mean(np.square(whitened)) < 1.25
    assert np.mean(np.square(in_noise)) > np.mean(np.square(whitened))
    strange = np.arange(4.0)
    np.testing.assert_array_equal(once().error_root(strange, np.arange(1.0, 5.0)), np.diag(np.arange(1.0, 5.0)))


def test_filter_linearises_once_with_an_error_covariance():
    """For two measurement vectors the innovations and their covariance equal those with voltages linearised about c_ref
    and the model's error covariance as noise; the estimate includes the variance of the state's
    error."""
    (example,) = examples("train:0")
    filter_ = inflow_filter(task(), replace(prior(), link="linear"), LEVEL, model=once())
    level = np.full(task().mesh.n_nodes, LEVEL)
    for voltages, currents in zip(example.voltages[:2], example.currents[:2], strict=True):
        before = copy.deepcopy(filter_.mean), filter_.covariance.copy()
        step = filter_.assimilate(voltages, currents)
        mean, covariance = filter_.space.propagate(*before, filter_.time)
        at = linearise_voltages(task().observation, task().noise, level, voltages, currents)
        std = np.sqrt(at.noise_variance)
        slope = filter_.space.jacobian(mean, at.matrix)
        known = covariance.array[:slope.shape[1], :slope.shape[1]]
        flow = LEVEL * at.matrix @ once().basis
        number = int(np.flatnonzero(np.isclose(once().current_patterns, currents).all(axis=1))[0])
        S = (slope @ known @ slope.T + flow @ once().residual_covariance @ flow.T
             + std[:, None] * once().voltage_error_covariance[number] * std)
        expected = at.value - at.matrix @ filter_.space.concentration(mean) - std * once().mean_voltage_error[number]
        np.testing.assert_allclose(step.innovation_covariance, S, rtol=1e-9, atol=1e-12 * S.max())
        np.testing.assert_allclose(step.innovation, expected, atol=1e-12)
    by_x = by_window(filter_.space, LEVEL)
    known = filter_.covariance.array[:by_x.shape[1], :by_x.shape[1]]
    variance = ((by_x @ known) * by_x).sum(axis=1) + ((LEVEL * once().root)**2).sum(axis=1)
    np.testing.assert_allclose(filter_.estimate().variance, variance, rtol=1e-9)


def surprise(space, before, covariance, x, voltages, currents):
    """Return −2 ln of the density of the newest inflows x given their prior and the measurements."""
    concentration = space.concentration(x)
    observation = linearise_voltages(task().observation, task().noise, concentration, voltages, currents)
    off = (observation.value - observation.matrix @ concentration) / np.sqrt(observation.noise_variance)
    return (x - before) @ np.linalg.solve(covariance, x - before) + (off**2).sum()


def test_iteration_is_closer_to_the_most_probable_inflow():
    """The second linearisation increases the density given one measurement vector; the innovation is the first one."""
    (example,) = examples("train:0")
    filters = [inflow_filter(task(), prior(), LEVEL, iterated=iterated) for iterated in (False, True)]
    space = filters[0].space
    before, covariance = space.propagate(*space.initial(), 1)
    measurement = example.voltages[0], example.currents[0]
    first, second = (each.assimilate(*measurement) for each in filters)
    np.testing.assert_array_equal(first.innovation, second.innovation)
    np.testing.assert_array_equal(first.innovation_covariance, second.innovation_covariance)
    values = [surprise(space, before, covariance.array, each.mean, *measurement) for each in filters]
    assert values[1] < values[0]


def test_smoother_subtracts_the_mean_error():
    """Voltages that exceed the model by exactly the mean error yield the inflows of the exact voltages."""
    (example,) = examples("train:0")
    plain = replace(model(), mean_voltage_error=np.zeros_like(model().mean_voltage_error))
    first = list(zip(example.voltages, example.currents, strict=True))
    without = full_window_filter(task(), prior(), LEVEL, first, model=plain)
    maximise_posterior(without, task(), first)
    last = len(first) - 1
    stds = [task().noise.std(task().observation.voltages(without.estimate(last - t).mean, I[None])[0])
            for t, (_, I) in enumerate(first)]
    shifted = [(V + model().mean_error(I, std), I) for (V, I), std in zip(first, stds, strict=True)]
    with_error = full_window_filter(task(), prior(), LEVEL, shifted, model=model())
    maximise_posterior(with_error, task(), shifted)
    np.testing.assert_allclose(with_error.mean, without.mean, atol=0.02)


def test_files_round_trip(tmp_path):
    """A saved model is loaded to single precision."""
    model().save(tmp_path / "a.npz")
    again = IdentifiedModel.load(tmp_path / "a.npz")
    np.testing.assert_allclose(again.response.weights, model().response.weights, atol=1e-6)
    np.testing.assert_allclose(again.residual_covariance, model().residual_covariance,
                               atol=1e-7 * model().residual_covariance.max())
    np.testing.assert_allclose(again.mean_error(task().currents[0], np.ones(4)),
                               model().mean_error(task().currents[0], np.ones(4)), atol=1e-6)
    assert again.voltage_error_covariance is None
    once().save(tmp_path / "a.npz")
    np.testing.assert_allclose(IdentifiedModel.load(tmp_path / "a.npz").voltage_error_covariance,
                               once().voltage_error_covariance, atol=1e-6)
    assert compatible_models(tmp_path, task())
    assert not compatible_models(tmp_path, make_task(PIPE_2D))


@pytest.mark.parametrize(("call", "message"), [
    (lambda: identify_model(examples("train:0"), modes=24), "more states than modes, 24; got 5"),
    (lambda: identify_model(examples("train:0-2"), modes=4, residual_only=True),
     "at least 4 episodes with residual_only, got 3"),
    (lambda: map_inflow(task(), prior(), LEVEL, [], model=once()),
     "model must have voltages that are linearised at each estimate"),
    (lambda: replace(model(), residual_covariance=np.eye(3)),
     r"residual_covariance must have shape \(24, 24\)"),
    (b"PK", r"b\.npz must be a model of `eitbench fit model`")])
def test_invalid_arguments_and_files_are_rejected(call, message, tmp_path):
    if isinstance(call, bytes):
        (tmp_path / "b.npz").write_bytes(call)
    with pytest.raises(ValueError, match=message):
        IdentifiedModel.load(tmp_path / "b.npz") if isinstance(call, bytes) else call()


@lru_cache(maxsize=1)
def quadratic():
    return QuadraticVoltageModel(task().observation, LEVEL, model().basis)


def along_modes(size):
    """Return a concentration with a deviation of ``size`` in some modes of its logarithm."""
    a = np.random.default_rng(7).standard_normal(model().basis.shape[1])
    u = model().basis @ a
    return LEVEL * np.exp(size * u / np.abs(u).max())


def test_quadratic_voltages_are_of_second_order():
    """Half the contrast along the modes has an eighth of the error, of third order; the voltages at c_0 are exact."""
    I = task().currents

    def off(size):
        c = along_modes(size)
        return np.linalg.norm(quadratic().voltages(c, I) - task().observation.voltages(c, I))

    assert off(0.0) < 1e-12
    assert 6.0 < off(0.2) / off(0.1) < 10.0
