"""The filters inside injection environments are the filters of the baselines."""

import numpy as np
import pytest
from eitbench.bench.methods import load_method
from eitbench.estimation import (
    CalibrationFrame,
    Filter,
    VelocityStates,
    inflow_filter,
    linearise_at_reference,
    nodal_filter,
    task_velocity_prior,
)
from eitbench.estimation.onboard.belief import Belief
from eitbench.estimation.onboard.full_filters import VELOCITY_BOUNDS
from eitbench.estimation.onboard.inflow_states import fit_world_prior

from injection_envs import FAULTS, FLOW, INFLOW, NAME, filter_of, make, some_pairs


def of_a_baseline(name, env) -> Filter:
    """Return the filter of a baseline about the same c_ref, which has the same bounds of a velocity."""
    task, level = env.task, float(filter_of(env).c_ref[0])
    if name == INFLOW:
        return inflow_filter(task, fit_world_prior(env.world), level)
    if name == FLOW:
        space = VelocityStates(task, level, task_velocity_prior(task, VELOCITY_BOUNDS))
        return Filter(space, linearise_at_reference(task, level))
    return nodal_filter(task.transport, task.prior, level, linearise_at_reference(task, level))


@pytest.mark.parametrize(("name", "estimator"), [(NAME, "full"), (FLOW, "full"), (INFLOW, "full"), (INFLOW, "reduced")])
def test_filter_is_the_full_one_of_a_baseline(name, estimator):
    """The full filter has its mean, spread, velocity and innovation at each step, and standard
    deviations of patch averages; the RMS difference of the reduced one is less than 1 mol/m³, with
    a learned inflow also than a tenth of the standard deviation."""
    env = make(estimator, name).unwrapped
    observation, _ = env.reset(seed=1)
    ours = of_a_baseline(name, env)
    first = CalibrationFrame(env.task)
    for voltages, currents in zip(observation["frame"], env.world.currents, strict=True):
        ours.assimilate(voltages, currents)
        first.add(voltages, currents)
    assert filter_of(env).c_ref[0] == pytest.approx(first.c_ref, rel=0.011)
    for action in some_pairs()[:env.core.length]:
        observation = env.step(int(action))[0]
        step = ours.assimilate(observation["voltages"], observation["currents"])
        (mean,), (spread,) = env.core.estimate()
        expected = ours.estimate()
        if estimator == "reduced":
            difference = np.sqrt(((mean - expected.mean)**2).mean())
            limit = 0.1 * np.sqrt(expected.variance.mean()) if name == INFLOW else 1.0
            assert 0.0 < difference < limit <= 1.0 < np.abs(expected.mean - first.c_ref).max()
            continue
        np.testing.assert_allclose(mean, expected.mean, rtol=1e-7)
        np.testing.assert_allclose(spread**2, expected.variance, rtol=1e-5, atol=1e-9)
        (innovation,) = env.core.filters.innovations()
        np.testing.assert_allclose(innovation.value, step.innovation, rtol=1e-6, atol=1e-10)
        np.testing.assert_allclose(innovation.covariance, step.innovation_covariance, rtol=1e-6, atol=1e-14)
        if name == FLOW:
            np.testing.assert_allclose(observation["velocity"], expected.velocity, rtol=1e-7)
            np.testing.assert_allclose(observation["velocity_std"]**2, expected.velocity_variance, rtol=1e-6)
    if name == NAME:
        operator, averages = filter_of(env), filter_of(env).table.grid_averages
        covariance = operator._filters[0].covariance
        variance = np.einsum("pn,np->p", averages, covariance.times(averages.T))
        expected = operator.c_ref[0] * np.sqrt(variance)
        np.testing.assert_allclose(observation["std"], expected, rtol=1e-8)


@pytest.mark.parametrize("name", [NAME, FLOW, INFLOW])
def test_design_criteria_are_decreases_of_the_expected_error(name):
    """A criterion is the decrease of the expected error over the region by a pair, or of its later content; the
    posterior covariance is the filter's after the injection."""
    env = make("reduced", name).unwrapped
    belief = Belief(env.rules, env.reset(seed=1)[0])
    for pair in (7, 100, 3):
        predicted = belief.predict_covariance()
        after, expected = belief.posterior_covariance(predicted, pair), belief.expected_error(predicted)
        gain = belief.design_criteria(predicted)[0][pair]
        assert gain == pytest.approx(expected - belief.expected_error(after), rel=1e-6)
        assert gain < expected
        if name == FLOW:
            total, changes = 0.0, predicted - after
            for k in range(4):
                total += belief.expected_error(changes)
                transition = belief._step(k + 1)[0]
                changes = transition @ changes @ transition.T
            weight = belief.future_error_weight(3)
            assert gain <= belief.design_criteria(predicted, weight=weight)[0][pair] == pytest.approx(total, rel=1e-6)
        observation = env.step(pair)[0]
        inside = filter_of(env).filter.covariance[0].astype(float)
        single = 2e-5 if name == NAME else 1e-3                                             # the filter's precision
        np.testing.assert_allclose(after, inside, atol=single * np.abs(inside).max())
        belief.update(observation)


@pytest.mark.parametrize("name", ["eitbench/Pipe2DInjectionInflowFaults-v0", FLOW, "eitbench/SearchAndTrack-v0"])
def test_trial_errors_are_those_of_actions_without_noise(name):
    """Trials change nothing; all states of the filter are copied, so the errors are equal to rounding."""
    core = make("reduced", name).unwrapped.core
    core.reset([3])
    for pair in some_pairs():
        core.act(pair[None])
        if core.t >= core.world.warm_up:
            break
    trials = core.trial_errors(np.array([7, 100]))
    np.testing.assert_array_equal(core.trial_errors(np.array([7, 100])), trials)
    core.load_until(core.t + 1)
    core._draws[core.t] = 0.0
    core.act(np.array([100]))
    assert core.errors()[0] == pytest.approx(trials[1], rel=1e-9)
    assert trials[0] != pytest.approx(trials[1], rel=1e-4)


def test_one_step_oracle_injects_the_best_pair_of_the_reduced_filter():
    """The oracle has its own reduced filter of the episode, also where the environment has the full one."""
    env, twin = make("full", FAULTS).unwrapped, make("reduced", FAULTS).unwrapped.core
    observation, _ = env.reset(seed=1)
    twin.reset([1])
    policy = load_method("one_step_oracle", "injection").make(twin.rules, np.random.default_rng(0), env.core)
    while env.core.t < env.world.n_steps:
        best = twin.trial_errors(np.arange(120)).argmin()
        assert policy.act(observation) == best
        twin.act(np.array([best]))
        observation = env.step(int(best))[0]
