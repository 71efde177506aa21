"""Uncertainty of the filter inside the environment is scored as for estimators."""

import json

import eitbench
import numpy as np
import pytest
from eitbench import scoring
from eitbench.bench import runner
from eitbench.bench.methods import load_method
from eitbench.bench.scores import Outcome, compute_scores
from eitbench.bench.tracks import Environment
from eitbench.data.episode_cache import mass_between
from eitbench.numerics.fem import mass_matrix
from eitbench.worlds import entry

from injection_envs import FAULTS, FLOW, NAME, make
from short import world

SEED = 5


def again(name: str, currents: np.ndarray) -> dict[str, list]:
    """Return the outputs of a separate environment at each scored step, for the same injections."""
    env = make("reduced", name).unwrapped
    env.reset(seed=SEED)
    pairs = env.rules.pairs.tolist()
    truth = eitbench.simulate(env.world, SEED).concentration.astype(float)
    seen: dict[str, list] = {key: [] for key in ("error", "mean", "std", "truth", "nis")}
    for k, each in enumerate(currents):
        pair = pairs.index([int(each.argmax()), int(each.argmin())]) if each.any() else None
        env.step(env.rules.action(pair))
        if env.error is None:
            continue
        mean, std = (part[0] for part in env.core.estimate())
        for key, value in (("error", env.error), ("mean", mean), ("std", std),
                           ("truth", truth[len(env.world.currents) + k + 1])):
            seen[key].append(value)
        if (innovation := env.core.filters.innovations()[0]) is not None:
            value, covariance = innovation
            seen["nis"].append(value @ np.linalg.inv(covariance) @ value / len(value))
    return seen


@pytest.mark.parametrize("name", [FAULTS, FLOW])
def test_uncertainty_is_of_the_filter_inside_the_environment(name):
    """CRPS, coverage and var/MSE equal their formulas for mean, standard deviation and truth at the truth nodes of the
    scored region; NIS/m is the mean over the injections with accepted measurements."""
    played = runner.run_method(
        Environment(name, json.dumps(world(name) | {"estimator": "reduced"})),
        load_method("random_pair", "injection"), SEED)
    seen = again(name, played.currents)
    env = make("reduced", name).unwrapped
    mesh = env.world.truth_model().transport.mesh
    onto = env.task.mesh.interpolation_to(mesh.points)
    mass = mass_between(mesh, *env.world.region) if env.world.region else mass_matrix(mesh)
    weights = np.asarray(mass.sum(axis=0)).ravel()
    claim = [np.array([onto @ state for state in seen[key]]) for key in ("mean", "std")]
    claim = [*claim, np.array(seen["truth"]), weights]
    said = compute_scores("injection", played.outcome)
    assert played.outcome.errors.tolist() == seen["error"]
    assert 0 < len(seen["nis"]) <= len(seen["error"]) == env.world.schedule.scored_steps
    expected = {"nis": np.mean(seen["nis"]), "crps": scoring.crps(*claim),
                "coverage_50": scoring.coverage(*claim, 0.5),
                "coverage_90": scoring.coverage(*claim, 0.9),
                "spread_ratio": scoring.spread_ratio(*claim)}
    assert {key: said[key] for key in expected} == pytest.approx(expected, rel=1e-9)
    assert 0.0 < said["crps"] < env.world.expected_concentration


def test_only_accepted_measurements_count():
    """Two accepted measurements and then one: (4/1 + 4/4)/2 = 2.5 and 9/1 = 9 have the mean 5.75."""
    innovations = ([np.array([2.0, 2.0]), np.array([3.0])], [np.diag([1.0, 4.0]), np.eye(1)])
    outcome = Outcome(entry(NAME).world, 0.0, np.ones(2), innovations=innovations)
    assert compute_scores("injection", outcome)["nis"] == pytest.approx(5.75)


def test_policies_do_not_observe_scored_quantities():
    """Scored quantities are neither in an observation nor in an info."""
    env = make("reduced")
    observation, info = env.reset(seed=SEED)
    known = set(observation)
    observation, *_, later = env.step(7)
    assert set(observation) == known == set(env.observation_space.spaces)
    assert set(info) == set(later) == {"step"}
