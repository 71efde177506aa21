"""Innovations of the filter inside injection environments, for scores."""

import copy

import numpy as np
import pytest
from eitbench.bench.scores import Outcome, compute_scores
from eitbench.estimation.onboard.linearisation import LinearisationTable
from eitbench.estimation.onboard.reduced_filters import ReducedFilters, SharedData

from injection_envs import BUDGET, FAULTS, FLOW, TANK, make, some_pairs


def predicted(filter_, estimator: str, n: int):
    """Return (mean, X -> Γ X) of the next state of the concentration, in the filter's coordinates."""
    moved = copy.deepcopy(filter_)
    moved.predict()
    if estimator == "reduced":
        r = moved.states.basis.shape[1]                             # followed by the velocity
        covariance = moved.covariance[0, :r, :r].astype(float)
        return moved.mean[0, :r].astype(float), lambda X: covariance @ X
    return moved.concentration, lambda X: moved.covariance.times(X)[:n]


@pytest.mark.parametrize(("name", "estimator"), [
    (FAULTS, "reduced"), (FAULTS, "full"), (BUDGET, "reduced"), (FLOW, "reduced"), (TANK, "reduced")])
def test_innovations_are_those_of_the_tasks_matrices(name, estimator):
    """ν = V − R(c*) − J (ĉ − c*) and S = J Γ Jᵀ + noise in volts, from the measured voltages, of
    accepted measurements; None for an injection with more than a third rejected."""
    env = make(estimator, name).unwrapped
    env.reset(seed=5)
    core, task, rules = env.core, env.task, env.rules
    operator = core.filters
    n = task.mesh.n_nodes
    level = operator.c_ref[0]
    basis = operator.shared.states.basis if estimator == "reduced" else np.eye(n)
    sizes = []
    for k, pair in enumerate(some_pairs()[:core.length]):
        before = operator.filter if estimator == "reduced" else operator._filters[0]
        mean, times = predicted(before, estimator, n)
        resting = name == BUDGET and k == 1
        observation = env.step(rules.action(None if resting else int(pair)))[0]
        said = core.filters.innovations()[0]
        if resting:
            assert said is None
            continue
        volts, jacobian = (part[0] for part in task.observation.linearise(
            np.full(n, level), observation["currents"][None]))
        H = level * jacobian @ basis
        away = mean if estimator == "reduced" else mean - 1.0
        instrument = rules.instrument
        std = np.maximum(instrument.noise.std(volts), 1e-3 * np.abs(volts).max())
        std = np.hypot(std, instrument.noise_floor)
        innovation = observation["voltages"] - volts - H @ away
        S = H @ times(H.T) + np.diag(std**2)
        beyond = np.abs(innovation) > rules.gate * np.sqrt(S.diagonal())
        used = ~beyond & (beyond.mean() <= 1 / 3)
        sizes.append(int(used.sum()))
        if not used.any():
            assert said is None
            continue
        close = 1e-7 if estimator == "full" else 1e-4
        scale = np.sqrt(S.diagonal())[used]
        np.testing.assert_allclose(said.value / scale, innovation[used] / scale, atol=close)
        np.testing.assert_allclose(said.covariance / np.outer(scale, scale),
                                   S[np.ix_(used, used)] / np.outer(scale, scale), atol=close)
    if name == FAULTS:
        assert 0 in sizes and 0 < max(sizes) < len(std)
    else:
        assert set(sizes) == {len(std)}


def nis_of(random, noise: float) -> float:
    """Return NIS/m of reduced filters of 32 episodes over 40 injections; voltages are drawn from
    the filter's model, with the noise multiplied by a factor."""
    env = make("reduced").unwrapped
    world, rules, B = env.world, env.rules, 32
    shared = SharedData.of(rules)
    model, level = shared.states.model, shared._level(0)
    root, initial = (vectors * np.sqrt(np.maximum(values, 0.0)) for values, vectors in (
        np.linalg.eigh(model.noise), np.linalg.eigh(model.initial)))
    state = random.standard_normal((B, len(root))) @ initial.T

    def measured(state, currents):
        volts = currents @ level.resistance
        std = shared.levels.noise_std(volts, 0.0)
        draws = noise * random.standard_normal((B, len(std)))
        return volts + state @ level.by_state(currents).T.astype(float) + std * draws

    pairs = rules.action_currents[some_pairs(40)]
    record = []
    for currents in [*world.currents, *pairs]:
        state = state @ model.transition.T + random.standard_normal(state.shape) @ root.T
        record.append(measured(state, currents))
    K = len(world.currents)
    operator = ReducedFilters(rules, np.stack(record[:K], axis=1))
    seen = []
    for currents, voltages in zip(pairs, record[K:], strict=True):
        operator.assimilate(voltages, np.repeat(currents[None], B, axis=0))
        seen += operator.innovations()
    innovations = [each.value for each in seen], [each.covariance for each in seen]
    return compute_scores("injection", Outcome(world, 0.0, np.zeros(1), innovations=innovations))["nis"]


def test_nis_of_a_consistent_filter_averages_one(monkeypatch):
    """Innovations of a filter with the correct model are independent: the mean of 20,480 squares is
    within four of its standard deviations of 1, and is not where the noise is twice as large."""
    monkeypatch.setattr(LinearisationTable, "nearest_indices", lambda self, frames, gate: [0] * len(frames))
    random = np.random.default_rng(0)
    spread = np.sqrt(2 / (32 * 40 * 16))
    assert abs(nis_of(random, 1.0) - 1.0) < 4 * spread
    assert nis_of(random, 2.0) > 1.0 + 40 * spread
