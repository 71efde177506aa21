"""Estimated electrode faults: against enumeration of all states, and in the environment."""

import sys
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from eitbench.data.episode_cache import instrument_faults
from eitbench.envs.injection_core import InjectionCore
from eitbench.estimation.onboard import episode_filters
from eitbench.estimation.onboard.belief import Belief
from eitbench.estimation.onboard.electrode_faults import BROKEN, LOOSE, ElectrodeFaults
from eitbench.estimation.onboard.rules import Rules
from eitbench.worlds import entry
from eitbench.worlds.instrument import Instrument
from scipy.stats import multivariate_normal

sys.path.append(str(Path(__file__).parents[2] / "studies"))
from electrode_faults import KnownFaults

ID = "eitbench/Pipe2DInjectionInflowFaults-v0"
L = 5
CURRENTS = np.array([0.1, 0.0, 0.0, -0.1, 0.0])
NOISE = 2e-3
INSTRUMENT = Instrument(noise_floor=NOISE, interference=0.5, n_dead_range=(0, 2),
                        n_loose_range=(0, 1))
WORLD = entry(ID).world
RULES = Rules(WORLD, inflow="learned", faults="estimated")
SEEDS = [1, 2, 3]
PRIOR = [1.0 - 1.0 / L - 0.5 / L, 1.0 / L, 0.5 / L]


def exact_probabilities(voltages, predicted, signal) -> np.ndarray:
    """Return the probabilities (L, 3) by enumeration of the states of all electrodes."""
    low, high = INSTRUMENT.loose_resistance
    driven = CURRENTS != 0.0
    probabilities = np.zeros((L, 3))
    for states in product(range(3), repeat=L):
        state = np.array(states)
        broken, loose = state == BROKEN, state == LOOSE
        flows = not (broken & driven).any()
        mean = (predicted + loose * 0.5 * (low + high) * CURRENTS) * flows
        noise = np.where(loose & flows, INSTRUMENT.loose_noise * NOISE, NOISE)**2
        noise += loose * flows * (high - low)**2 / 12.0 * CURRENTS**2
        covariance = signal * flows + np.diag(noise)
        mean[broken] = 0.0
        covariance[broken] = covariance[:, broken] = 0.0
        covariance[broken, broken] = INSTRUMENT.interference**2
        joint = np.prod([PRIOR[each] for each in states])
        joint *= multivariate_normal(mean, covariance).pdf(voltages)
        probabilities[np.arange(L), state] += joint
    return probabilities / probabilities.sum(axis=1, keepdims=True)


def draws(count: int) -> list[tuple[np.ndarray, ...]]:
    """Draw voltages, predicted voltages and signal covariances of faulty instruments."""
    random = np.random.default_rng(5)
    drawn = []
    for _ in range(count):
        root = random.standard_normal((L, 3))
        signal = 0.02**2 * root @ root.T                   # correlated voltages of 20 mV
        predicted = random.uniform(-0.2, 0.2, L)
        faults = INSTRUMENT.draw(random, L, 10)
        resistance = faults.resistance * (CURRENTS != 0.0)
        broken = faults.open_circuit_from == 0
        flows = not (broken & (CURRENTS != 0.0)).any()
        clean = random.multivariate_normal(predicted, signal) + resistance * CURRENTS
        noise = NOISE * np.where(flows, faults.noise_factor, 1.0) * random.standard_normal(L)
        voltages = np.where(broken, 0.5 * random.standard_normal(L), clean * flows + noise)
        drawn.append((voltages, predicted, signal))
    return drawn


def test_probabilities_are_near_those_of_enumeration() -> None:
    count = 60
    voltages, predicted, signal = map(np.array, zip(*draws(count), strict=True))
    faults = ElectrodeFaults(INSTRUMENT, (count, L), 10)
    assert faults.probabilities[0, 0] == pytest.approx(PRIOR)
    faults.update(voltages, voltages - predicted, signal, np.full((count, L), NOISE**2),
                  np.tile(CURRENTS, (count, 1)))
    exact = np.array(list(map(exact_probabilities, voltages, predicted, signal)))
    difference = np.abs(faults.probabilities - exact)
    assert difference.mean() < 0.03                                  # 0.16 after the first sweep
    decided = faults.probabilities[..., BROKEN] > 0.5
    assert (decided == (exact[..., BROKEN] > 0.5)).mean() > 0.98


def play(rules: Rules, seeds: list[int], estimator: str = "reduced") -> tuple[InjectionCore, np.ndarray]:
    """Inject the same random pairs in episodes; return the core and the errors (steps, B)."""
    core = InjectionCore(rules, estimator)
    core.reset(seeds)
    pairs = np.random.default_rng(0).integers(len(rules.pairs), size=core.length)
    errors = []
    for pair in pairs:
        core.act(np.full(len(seeds), pair))
        errors.append(core.errors())
    return core, np.array(errors)


@pytest.fixture(scope="module")
def played() -> tuple[InjectionCore, np.ndarray]:
    return play(RULES, SEEDS)


def test_faults_of_the_environment_are_found(played):
    """At the end of an episode all broken wires and bad contacts are known; other electrodes are intact."""
    core, _ = played
    probabilities = core.filters.faults.probabilities
    broken = core.faults.open_circuit_from <= core.t - 16               # measured since
    late = core.faults.open_circuit_from <= core.t
    loose = (core.faults.noise_factor > 1.0) & ~late
    assert broken.sum() >= 8
    assert probabilities[broken, BROKEN].min() > 0.99
    assert probabilities[~late, BROKEN].max() < 0.01
    assert probabilities[loose, LOOSE].min() > 0.9
    assert probabilities[~late & ~loose, LOOSE].max() < 0.1


def test_a_filter_with_estimated_faults_is_as_good_as_with_known_ones(played, monkeypatch):
    core, errors = played
    monkeypatch.setattr(episode_filters, "ElectrodeFaults",
                        lambda instrument, shape, n_steps: KnownFaults(instrument, n_steps, core.faults))
    told = play(RULES, SEEDS)[1]
    assert np.nanmean(errors, axis=0) == pytest.approx(np.nanmean(told, axis=0), rel=0.02)


def test_full_filter_finds_the_same_faults(played):
    core, errors = played
    full, full_errors = play(RULES, SEEDS[:1], "full")
    assert np.nanmean(full_errors) == pytest.approx(np.nanmean(errors[:, 0]), rel=0.03)
    np.testing.assert_allclose(full.filters.faults.probabilities[0],
                               core.filters.faults.probabilities[0], atol=0.05)


def test_an_episode_does_not_depend_on_the_others(played):
    np.testing.assert_array_equal(play(RULES, SEEDS[1:2])[1][:, 0], played[1][:, 1])


def test_without_faults_the_filter_is_the_plain_one() -> None:
    """Errors in an episode without faults agree within 2 % with the plain filter; the large gate selects the same
    robust fit of c_ref."""
    intact = replace(WORLD, instrument=replace(
        WORLD.instrument, n_dead_range=(0, 0), n_failing_range=(0, 0), n_loose_range=(0, 1)))
    seeds = [seed for seed in range(1, 40)
             if (instrument_faults(intact, seed).noise_factor == 1.0).all()][:1]
    estimated = play(Rules(intact, inflow="learned", faults="estimated"), seeds)[1]
    plain = play(Rules(intact, gate=1e9, inflow="learned"), seeds)[1]
    np.testing.assert_allclose(np.nanmean(estimated, axis=0), np.nanmean(plain, axis=0), rtol=0.02)


def test_criteria_avoid_broken_electrodes(played):
    core, _ = played
    belief = Belief(RULES, {name: array[0] for name, array in core.observe().items()})
    probabilities = belief.filters.faults.probabilities
    probabilities[0] = [1.0, 0.0, 0.0]
    before = belief.criteria()[0]
    probabilities[0, 3] = [0.0, 1.0, 0.0]
    belief._clear_cache()
    after = belief.criteria()[0]
    touched = (RULES.pairs == 3).any(axis=1)
    assert (after[touched] == 0.0).all()
    assert (after[~touched] > 0.0).all()
    assert (after[~touched] < before[~touched]).all()


def test_open_inputs_may_measure_zero() -> None:
    """Broken wires without interference are found too."""
    quiet = replace(WORLD, instrument=replace(WORLD.instrument, interference=0.0))
    core, errors = play(Rules(quiet, inflow="learned", faults="estimated"), SEEDS[:1])
    broken = core.faults.open_circuit_from <= core.t - 16
    assert core.filters.faults.probabilities[broken, BROKEN].min() > 0.99
    assert np.isfinite(errors[-1]).all()
