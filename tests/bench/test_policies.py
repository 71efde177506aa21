"""Injection policies: belief, rollouts, scores of the filter inside the environment, and error messages."""

import json
from types import SimpleNamespace

import eitbench
import numpy as np
import pandas as pd
import pytest
from eitbench import scoring
from eitbench.bench import runner
from eitbench.bench.methods import builtin_methods, load_method
from eitbench.bench.run import Job, run_jobs
from eitbench.bench.scores import compute_scores
from eitbench.bench.store import EpisodeStore
from eitbench.bench.tracks import Environment
from eitbench.data.episode_cache import mass_between, truth_mesh
from eitbench.data.seeds import parse_seeds
from eitbench.envs.injection import InjectionEnv
from eitbench.estimation.onboard.belief import Belief
from eitbench.estimation.onboard.rules import Rules
from eitbench.numerics.fem import mass_matrix
from eitbench.report.policies import (
    adaptive_ratio,
    adaptivity_gap,
    attained_fraction,
    errors_by_policy,
    gap_text,
    policy_rows,
)
from eitbench.worlds import entry
from eitbench.worlds.catalogue import PIPE_2D
from scipy.stats import t as student

from injection_envs import BUDGET, CURRENTS, FAULTS, FLOW, INFLOW, NAME, TANK, filter_of, injected, make
from short import merged, world
from tiny import write_policy

SHORT = world(NAME)
KWARGS = {name: world(name) for name in (NAME, INFLOW, CURRENTS, FAULTS, FLOW, TANK)} | {
    BUDGET: merged(world(BUDGET), {"world": {"schedule": {"budget": 3}}})}
SEED = 5


def environment(name: str) -> InjectionEnv:
    return runner.cached_environment(Environment(name, json.dumps(KWARGS[name] | {"estimator": "reduced"})))


@pytest.mark.parametrize("name", [NAME, INFLOW, FAULTS, BUDGET, FLOW])
def test_belief_is_the_filter_inside(name):
    """A belief that a policy updates equals the environment's reduced filter, to the bit. A pair's action injects its
    currents."""
    env = environment(name)
    observation, _ = env.reset(seed=SEED)
    belief = Belief(env.rules, observation)
    for pair in (7, 100, None if env.rules.budget else 3, 7):
        belief.predict_covariance()                                      # changes nothing
        observation, *_ = env.step(env.rules.action(pair))
        expected = np.zeros(16)
        if pair is not None:
            expected[env.rules.pairs[pair]] = env.rules.amplitude, -env.rules.amplitude
        np.testing.assert_allclose(observation["currents"], expected)
        belief.update(observation)
        inside = filter_of(env)
        np.testing.assert_array_equal(belief.mean, inside.means()[0])
        expected = inside.filter.covariance[0].astype(float)
        np.testing.assert_array_equal(filter_of(belief).filter.covariance[0], expected)


def test_faulty_electrodes_have_no_design_criterion():
    """Pairs with a faulty electrode have criterion 0, others less than with all measurements, but more than 0."""
    env = environment(NAME)
    belief = Belief(env.rules, env.reset(seed=SEED)[0])
    predicted, sound = belief.predict_covariance(), np.arange(16) != 3
    every, fewer = belief.design_criteria(predicted)[0], belief.design_criteria(predicted, sound)[0]
    touched = (env.rules.pairs == 3).any(axis=1)
    assert not fewer[touched].any() and (fewer[~touched] > 0.0).all() and (fewer[~touched] < every[~touched]).all()
    k = int(np.flatnonzero(~touched)[0])
    assert fewer[k] == pytest.approx((predicted - belief.posterior_covariance(predicted, k, sound)).trace(), rel=1e-6)
    assert (belief.posterior_covariance(predicted, int(np.flatnonzero(touched)[0]), sound) == predicted).all()


def test_fault_scores_decay():
    """Failed injections raise both electrodes' scores, which decay without injections unless measurements misfit."""
    env = environment(FAULTS)
    observation, _ = env.reset(seed=SEED)
    belief, currents, doubt = Belief(env.rules, observation), np.zeros((2, 16)), np.zeros((2, 16))
    assert belief.healthy_electrodes.all()
    currents[0, [2, 9]], currents[1, [0, 15]], doubt[1, [2, 9]] = (1.0, -1.0), (1.0, -1.0), 0.36
    belief.update(observation | {"currents": currents[0], "doubt": doubt})
    assert np.flatnonzero(~belief.healthy_electrodes).tolist() == [2, 9]
    doubt[0, 9] = 0.2                            # the environment keeps the fault score of unused drivers
    belief.update(observation | {"currents": currents[1], "doubt": doubt})
    assert np.flatnonzero(~belief.healthy_electrodes).tolist() == [9]
    np.testing.assert_allclose(belief.fault_score[[2, 9]], [0.8 * 0.36, 0.8 * 0.36 + 0.2])
    assert not {2, 9} & set(env.rules.pairs[belief.most_reliable_pair])


def test_look_ahead_finds_the_best_plan():
    """Depth 2 with a beam of all pairs is the minimum over all plans; depth 1 is greedy."""
    env = environment(NAME)
    belief, sound = Belief(env.rules, env.reset(seed=SEED)[0]), np.arange(16) % 3 != 0
    predicted = belief.predict_covariance()
    gains, costs = belief.design_criteria(predicted, sound)[0], []
    for pair, gain in enumerate(gains):
        later = belief.predict_covariance(belief.posterior_covariance(predicted, pair, sound))
        costs.append(-gain + later.trace() - belief.design_criteria(later, sound)[0].max())
    assert belief.look_ahead(1, 4, sound) == gains.argmax()
    assert belief.look_ahead(2, len(gains), sound) == np.argmin(costs)


def test_the_prior_belief_is_the_expected_concentration():
    """A belief without data is linear about the expected concentration, at which both derivatives agree."""
    env = environment(NAME)
    belief = Belief.from_prior(env.rules)
    assert filter_of(belief).c_ref[0] == pytest.approx(env.world.expected_concentration, rel=1e-12)
    level = filter_of(belief).c_ref[0]
    assert np.abs(belief.mean / level - 1.0).max() < 0.01
    about_c_ref = belief.linearisation.jacobian
    np.testing.assert_allclose(belief.relinearised_jacobian(), about_c_ref, rtol=0.1,
                               atol=0.02 * np.abs(about_c_ref).max())


@pytest.mark.parametrize("budget", [0, 1, 7, 30, 182, 500])
def test_an_even_budget_is_spent_exactly(budget):
    """Intervals differ by one step at most; a budget above the number of steps injects in each step."""
    rules = Rules(PIPE_2D.with_changes({"schedule": {"scored_steps": 180, "budget": budget}}))
    steps = rules.world.n_steps - 16
    when = np.flatnonzero([rules.is_injection_step(np.array([left, 0.0])) for left in range(steps, 0, -1)])
    assert len(when) == min(budget, steps)
    assert len(when) < 2 or np.ptp(np.diff([-1, *when])) <= 1


def test_slug_triggered_follows_a_slug_and_rests_after_it():
    """The remaining injections are evenly spaced, then every third step while the last one shows a slug at the inlet:
    at first a weak one, which has left three steps later, then a strong one. After each, ten steps have none."""
    rules = Rules(entry("eitbench/Pipe2DInjectionInflowBudget-v0").world, inflow="learned")
    policy = load_method("slug_triggered", "injection").make(rules, np.random.default_rng(0))
    idle, left, injected = rules.action(None), 30, []
    currents = np.zeros(16)
    for k in range(180):
        mean = np.full(36, 400.0)
        mean[12] *= 1.06 + 0.04 * (k > 26) if 12 <= k < 40 else 1.04           # row 1, column 0
        action = policy.act({"currents": currents, "mean": mean, "left": np.array([180.0 - k, left])})
        assert action == idle or rules.pairs[action].tolist() == [0, 9]
        currents = rules.currents(np.array([action]))[0]
        left -= action != idle
        injected += [k] * (action != idle)
    assert injected[:11] == [5, 11, 14, 25, 28, 31, 34, 37, 40, 51, 58]
    assert len(injected) == 30 and injected[-1] == 174


def test_attainable_oracle_knows_the_truth_at_its_injections_only(monkeypatch):
    """A slug at the inlet adds injections at short intervals; the truth at other times has no effect."""
    rules = Rules(entry("eitbench/Pipe2DInjectionInflowBudget-v0").world, inflow="learned")
    policy_type = load_method("attainable_oracle", "injection").make
    monkeypatch.setitem(policy_type.__init__.__globals__, "simulate",
                        lambda *_, **__: SimpleNamespace(concentration=truth))
    inlet = truth_mesh(rules.world).points[:, 0] < 0.01
    empty = np.ones((181, len(inlet)))

    def measured_at():
        """Return the times of the measurements of the policy's injections."""
        core = SimpleNamespace(t=0, seeds=[0])
        policy, currents, times = policy_type(rules, np.random.default_rng(0), core), np.zeros(16), []
        for core.t in range(180):
            left = np.array([180.0 - core.t, 30.0 - len(times)])
            action = policy.act({"currents": currents, "mean": np.full(36, 400.0), "left": left})
            currents = rules.currents(np.array([action]))[0]
            times += [core.t + 1] * bool(currents.any())
        return times

    truth = empty
    evenly = measured_at()
    truth = empty + 0.3 * (inlet & (np.abs(np.arange(181) - 60) < 10)[:, None])
    times = measured_at()
    assert min(np.diff(times)) == 3 and min(np.diff(evenly)) >= 5
    truth = truth + 0.5 * (inlet & ~np.isin(np.arange(181), times)[:, None])
    assert measured_at() == times


@pytest.mark.parametrize("name", [CURRENTS, BUDGET, FLOW, TANK])
@pytest.mark.parametrize("policy", builtin_methods("injection"))
def test_policies_run_in_compatible_environments(policy, name, monkeypatch):
    """Actions are valid and within the budget; incompatible environments are rejected."""
    env = environment(name)
    if not load_method(policy, "injection").suits(env.rules):
        with pytest.raises(ValueError, match=f"policy {policy} does not suit {name}"):
            injected(name, KWARGS[name], policy, SEED, "reduced")
        return
    taken, step = [], InjectionEnv.step
    monkeypatch.setattr(InjectionEnv, "step", lambda self, action: taken.append(np.array(action)) or step(self, action))
    played = injected(name, KWARGS[name], policy, SEED, "reduced")
    dtype = np.float32 if env.rules.limit else np.int64
    assert all(env.action_space.contains(action.astype(dtype)) for action in taken) and len(taken) == env.core.length
    assert played.n_injections <= (len(taken) if env.rules.budget is None else env.rules.budget)
    assert len(played.errors) == env.world.schedule.scored_steps
    assert 0.0 < played.errors.mean() < 1.0 and played.seconds_per_step >= 0.0


def test_finished_and_failed_episodes_are_stored(tmp_path):
    """The record has the same format as for estimators; a failed episode has the reason, and no row."""
    store = EpisodeStore(tmp_path / "new")
    bad = write_policy(tmp_path, "return 0.5", "bad")
    reduced = Environment(NAME, json.dumps(SHORT | {"estimator": "reduced"}))
    todo = [Job(reduced, policy, seed) for policy in ("random_pair", "adjacent", bad)
            for seed in parse_seeds("dev:1,0")]
    run_jobs(todo, store, command="eitbench run")
    errors = policy_rows(todo, store.results()).set_index(["policy", "seed"])["error"]
    assert sorted(errors.index) == [(policy, f"dev:{k}") for policy in ("adjacent", "random_pair") for k in (0, 1)]
    played = injected(NAME, SHORT, "adjacent", parse_seeds("dev:0")[0], "reduced")
    assert errors["adjacent", "dev:0"] == played.errors.mean()
    record, failed, floor = store.write_records()
    assert (record["board"], record["method"], record["seeds"]) == ("injection", "adjacent", ["dev:0", "dev:1"])
    assert record["environment"]["kwargs"]["estimator"] == "reduced"
    assert record["episodes"][0]["scores"]["spent"] == played.n_injections > 0
    assert record["episodes"][0]["step_errors"] == played.errors.tolist()
    assert "action must be an integer" in failed["episodes"][0]["message"] and failed["role"] is None
    assert floor["episodes"][0]["status"] == "ok" and floor["role"] == "floor"


def test_errors_of_policies_are_ordered_and_pool_trainings():
    """A policy with a failed episode is last; training seeds of an agent are averaged."""
    errors = {"clairvoyant": [1.0, 2.0, 3.0], "best_pair": [2.0, 3.1, 4.0], "random_pair": [3.0, 4.1, 5.2],
              "bold": [0.5, 1.0], "ppo_seed0": [1.7, 1.8, 1.9], "ppo_seed1": [2.3, 2.4, 2.5]}
    rows = hand_made(**errors)
    found = errors_by_policy(rows)
    assert list(found) == ["clairvoyant", "ppo", "best_pair", "random_pair", "bold"]
    assert found["ppo"].tolist() == pytest.approx([2.0, 2.1, 2.2])
    ratio, few = "error of ppo / best_pair: 0.69", "(an interval takes 6 episodes)"
    assert gap_text(rows) == f"{ratio} {few}; normalised adaptivity gap 0.49 {few} over 3 episodes"
    assert gap_text(rows[rows["policy"] != "clairvoyant"]) == f"{ratio} {few} over 3 episodes"
    assert gap_text(rows[rows["policy"] == "random_pair"]) == ""


@pytest.mark.parametrize(("name", "policy", "estimator", "message"), [
    (NAME, "mine.py", "full", r"mine\.py: Policy must have a method act\(observ"),
    ("eitbench/Pipe2D-v0", "adjacent", "full", "environment eitbench/Pipe2D-v0 is not of the track inj"),
    (NAME, "adjacent", "none", "estimator must be one of full, reduced; got 'none'")])
def test_mistakes_are_explained(name, policy, estimator, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text("class Policy: pass")
    with pytest.raises(ValueError, match=message):
        injected(name, {}, policy, 1, estimator)


def hand_made(**errors: list[float]) -> pd.DataFrame:
    rows = [{"policy": policy, "seed": f"dev:{k}", "error": error}
            for policy, each in errors.items() for k, error in enumerate(each)]
    return pd.DataFrame(rows)


def test_adaptivity_gap_is_the_formula():
    """The gap is (2 − 1)/(5 − 1) for a given table; the open-loop policy with the smaller mean is used. Two episodes
    are too few for an interval."""
    table = hand_made(clairvoyant=[1.0, 1.0], random_pair=[4.0, 6.0], a=[1.5, 2.5], b=[1.0, 9.0], spy=[0.0, 0.0])
    assert adaptivity_gap(table, ["b", "a"]) == adaptivity_gap(table, ["a", "b"]) == (0.25, -np.inf, np.inf)
    same = hand_made(clairvoyant=[1.0] * 9, random_pair=[5.0] * 9, a=[2.0] * 9)
    assert adaptivity_gap(same, ["a"]) == (0.25, 0.25, 0.25)
    for incomplete in ([], ["c"]):
        with pytest.raises(ValueError, match="rows must hold clairvoyant, random_pair and some open-loop policies"):
            adaptivity_gap(pd.concat([table, hand_made(c=[2.0])]), incomplete)


def test_ratios_compare_means():
    """The mean errors are 4, 2 and 1: the fraction of the oracle's gain is 2/3. The best policy of each kind counts,
    without oracles and random pairs. For policies with the score of a body the text has the ratio of mean squares."""
    table = hand_made(best_cycle=[2.0, 4.0, 6.0], greedy_a=[1.0, 3.0, 2.0], one_step_oracle=[1.0, 1.0, 1.0])
    fraction = attained_fraction(table, "greedy_a", "best_cycle", "one_step_oracle")
    assert fraction == (pytest.approx(2.0 / 3.0), -np.inf, np.inf)
    assert "(best_cycle − greedy_a) / (best_cycle − one_step_oracle): 0.67" in gap_text(table.assign(ospa=None))
    table = hand_made(clairvoyant=[0.1] * 9, random_pair=[0.2] * 9, best_cycle=[2.0, 4.0] * 4 + [3.0],
                      best_pair=[5.0] * 9, mine=[1.0, 2.0] * 4 + [1.5], other=[4.0] * 9)
    assert adaptive_ratio(table) == ("mine", "best_cycle", *[pytest.approx(0.5)] * 3)
    assert "OSPA" not in gap_text(table.assign(ospa=None))
    found = gap_text(table.assign(ospa=2.0 * table["error"]))
    assert "mean squared OSPA of mine / best_cycle: 0.25 (95 % interval 0.25 to 0.25)" in found
    with pytest.raises(ValueError, match="rows must hold an adaptive and an open-loop policy"):
        adaptive_ratio(hand_made(random_pair=[1.0], best_pair=[2.0]))


def test_the_interval_of_the_adaptivity_gap_is_student_s():
    """The interval of the ratio of means is linearised; plain percentiles are 8 % narrower at n = 12."""
    random = np.random.default_rng(5)
    best, lot, seer = (level * (1.0 + 0.1 * random.standard_normal(12)) for level in (2.0, 5.0, 1.0))
    gap, low, high = adaptivity_gap(hand_made(clairvoyant=seer, random_pair=lot, a=best), ["a"])
    span = (lot - seer).mean()
    assert gap == pytest.approx((best - seer).mean() / span, rel=1e-12)
    slopes = ((best - seer) - gap * (lot - seer)) / span
    half = student.ppf(0.975, 11) * slopes.std(ddof=1) / np.sqrt(12)
    assert (high - low) / 2 == pytest.approx(half, rel=0.04)


def seen_in_a_separate_environment(name: str, currents: np.ndarray) -> dict[str, list]:
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
    seen = seen_in_a_separate_environment(name, played.currents)
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


def test_policies_do_not_observe_scored_quantities():
    env = make("reduced")
    observation, info = env.reset(seed=SEED)
    known = set(observation)
    observation, *_, later = env.step(7)
    assert set(observation) == known == set(env.observation_space.spaces)
    assert set(info) == set(later) == {"step"}
