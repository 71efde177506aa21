"""Training with stable-baselines3: agents learn from the environments, and interrupted runs resume."""

import json
from dataclasses import asdict, replace
from zipfile import ZIP_DEFLATED, ZipFile

import gymnasium as gym
import numpy as np
import pytest
from eitbench.bench.methods import load_method
from eitbench.bench.runner import iter_injections
from eitbench.envs.injection import InjectionVectorEnv
from eitbench.estimation.onboard.rules import Rules
from eitbench.rl import training
from eitbench.rl.agents import configuration_hash, load_agent
from eitbench.rl.networks import MaskablePairPolicy, PairPolicy, most_probable
from eitbench.rl.training import ALGORITHMS, TrainingConfig, read_config, train
from eitbench.rl.vec_env import InjectionVecEnv
from eitbench.worlds.catalogue import PIPE_2D
from stable_baselines3.common.monitor import load_results
from threadpoolctl import threadpool_limits

from injection_envs import BUDGET, CURRENTS, NAME, injected
from short import merged, world

SHORT = world(NAME)
"""An episode with six steps of the agent."""
TINY = TrainingConfig(total_steps=32, n_envs=2, interval=16, evaluation_episodes=2, episodes=3, hidden=(8,),
              algorithm={"n_steps": 8, "batch_size": 8})
RUNS = {"ppo": (NAME, TINY.algorithm), "maskable_ppo": (BUDGET, TINY.algorithm),
        "recurrent_ppo": (NAME, TINY.algorithm),
        "dqn": (NAME, {"learning_starts": 4, "train_freq": 4}),
        "sac": (CURRENTS, {"learning_starts": 4, "batch_size": 4})}


@pytest.fixture(scope="module", params=ALGORITHMS)
def run(request, tmp_path_factory):
    """A finished training of each algorithm: environment, arguments, algorithm, configuration, and model."""
    algo = request.param
    env, options = RUNS[algo]
    kwargs = merged(SHORT, {"world": {"schedule": {"budget": 2}}}) if env == BUDGET else SHORT
    config = replace(TINY, algorithm=options)
    return env, kwargs, algo, config, train(env, algo, config, 1, tmp_path_factory.mktemp(algo), kwargs)


def vector(episodes=3):
    return gym.make_vec(NAME, num_envs=3, vectorization_mode="vector_entry_point", episodes=episodes, **SHORT)


def test_sb3_receives_the_observations_of_the_environments():
    """Each step has the observations and rewards of Gymnasium's vector, across episodes; rewards are scaled."""
    envs, plain = vector(), vector()
    ours = InjectionVecEnv(envs, reward_scale=10.0)
    ours.seed(5)
    shown = ours.reset()
    started = list(envs.seeds)
    assert len(set(started)) == 3                       # else environments with equal seeds would be identical
    np.testing.assert_array_equal(shown, plain.reset(seed=started)[0])
    assert ours.get_attr("action_space") == 3 * [plain.single_action_space]
    assert ours.get_attr("observation_space", [1]) == [plain.single_observation_space]
    rng = np.random.default_rng(0)
    for step in range(1, 8):
        actions = rng.integers(120, size=3)
        shown, rewards, ended, infos = ours.step(actions)
        expected, earned, over, *_ = plain.step(actions)
        np.testing.assert_allclose(rewards, 10.0 * earned, rtol=1e-6)
        assert ended.all() == (step == 6) == over.all()
        if step == 6:
            np.testing.assert_array_equal([info["terminal_observation"] for info in infos], expected)
            expected = plain.step(actions)[0]                                              # begins the next episode
        np.testing.assert_array_equal(shown, expected)


def test_every_algorithm_finishes_a_run(run):
    """A run has model, configuration, evaluations of the model, and a checksum; the same command changes nothing."""
    env, kwargs, algo, config, path = run
    folder = path.parent
    model = ALGORITHMS[algo].load(path)
    assert 32 <= model.num_timesteps < 48
    kept = np.load(folder / "evaluations.npz")
    steps = kept["timesteps"]
    assert steps[0] == 0 and (np.diff(steps) > 0).all() and steps[-1] == model.num_timesteps
    errors, returns, lengths = training.make_evaluator(env, kwargs, config)(model)
    np.testing.assert_allclose(kept["errors"][-1], errors, rtol=1e-6)
    np.testing.assert_allclose(kept["results"][-1], returns, rtol=1e-6)
    np.testing.assert_array_equal(kept["ep_lengths"][-1], lengths)
    assert load_results(str(folder))["l"].isin(lengths).all()
    assert json.loads((folder / "config.json").read_text())["algo"] == algo
    assert not (getattr(model.policy, "actor", None) or model.policy).optimizer.state
    assert len((folder / "sha256").read_text()) == 64 and not (folder / "latest.zip").exists()
    with ZipFile(path) as model_zip:                                                     # fifteen are stored in git
        assert {file.compress_type for file in model_zip.infolist()} == {ZIP_DEFLATED}
    before = {each: each.stat().st_mtime_ns for each in folder.iterdir()}
    assert train(env, algo, config, 1, folder, kwargs) == path
    assert before == {each: each.stat().st_mtime_ns for each in folder.iterdir()}


def test_an_agent_acts_as_it_was_evaluated(run):
    """The errors of its policy equal the last evaluation, for any filter of the environment."""
    env, kwargs, algo, config, path = run
    expected = np.load(path.parent / "evaluations.npz")["errors"][-1]
    errors = [injected(env, kwargs, str(path), seed, "reduced").errors.mean() for seed in (100_000, 100_001)]
    np.testing.assert_allclose(errors, expected, rtol=1e-5)
    agent = load_method(str(path), "injection")
    asked = json.loads((path.parent / "config.json").read_text())
    mark = configuration_hash(asked)
    assert asked["config"] == json.loads(json.dumps(asdict(config)))
    assert agent.name == f"{algo}_{mark}_seed1" and mark == configuration_hash(asked | {"seed": 2})
    assert mark != configuration_hash(asked | {"kwargs": {}})
    assert not agent.privileged and agent.parameters["env"] == env
    other = {"instrument": {"current_norm": None if env == CURRENTS else "L1"}}
    assert not agent.suits(Rules(PIPE_2D.with_changes(other)))
    if algo == "ppo":
        envs = (gym.make(env, estimator=estimator, observation="raw", **kwargs).unwrapped
                for estimator in ("reduced", "full"))
        chosen = [[seen["currents"] for _, seen, *_ in iter_injections(each, agent, 7)]
                  for each in envs]
        np.testing.assert_array_equal(*chosen)


def test_a_killed_run_loses_no_more_than_an_interval(tmp_path, monkeypatch):
    """It resumes from its last checkpoint to the full number of steps; a changed model is not loaded."""
    keep, calls = training._Checkpoints._on_training_end, []

    def kill(self):
        keep(self)
        calls.append(self.num_timesteps)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(training._Checkpoints, "_on_training_end", kill)
        with pytest.raises(KeyboardInterrupt):
            train(NAME, "ppo", TINY, 1, tmp_path, SHORT)
    assert calls == [16]
    path = train(NAME, "ppo", TINY, 1, tmp_path, SHORT)
    assert ALGORITHMS["ppo"].load(path).num_timesteps == 32
    assert np.load(tmp_path / "evaluations.npz")["timesteps"].tolist() == [0, 16, 32]
    assert len(list(tmp_path.glob("*.monitor.csv"))) == 2
    with pytest.raises(ValueError, match=r"out must be empty, or of the same run; .* has seed 1, not 2"):
        train(NAME, "ppo", TINY, 2, tmp_path, SHORT)
    content = path.read_bytes()
    path.write_bytes(content + b"x")
    assert load_agent(path, content)[0].startswith("ppo_")       # the checked content is loaded, not the file
    with pytest.raises(ValueError, match="must have the sha256 of its folder"):
        load_method(str(path), "injection")
    (tmp_path / "sha256").unlink()
    with pytest.raises(ValueError, match="must be in a folder with the config"):
        load_method(str(path), "injection")


def test_the_same_seed_learns_the_same(tmp_path):
    """Two runs give the same networks, for any number of threads; another seed gives others."""
    config = replace(TINY, n_envs=32, total_steps=256)            # large enough for multithreaded products

    def networks(seed, name, threads):
        with threadpool_limits(threads):
            model = ALGORITHMS["ppo"].load(train(NAME, "ppo", config, seed, tmp_path / name, SHORT))
        return np.concatenate([p.detach().numpy().ravel() for p in model.policy.parameters()])
    first, again, other = networks(1, "a", 1), networks(1, "b", 2), networks(2, "c", 1)
    assert (first == again).all() and (first != other).any()


def test_failed_estimates_are_in_evaluations(monkeypatch):
    """Unscored states are excluded from an evaluation, failed estimates of scored states are not."""
    class Still:
        def predict(self, *_, **__):
            return np.zeros(2, dtype=int), None

    step = InjectionVectorEnv.step

    def fail_at_the_end(env, actions):
        *rest, ended, truncated, info = step(env, actions)
        if ended.any():
            info["error"][1] = np.nan
        return *rest, ended, truncated, info

    monkeypatch.setattr(InjectionVectorEnv, "step", fail_at_the_end)
    assert list(np.isnan(training.make_evaluator(NAME, SHORT, TINY)(Still())[0])) == [False, True]


def test_imitation_learns_the_teachers_actions(tmp_path):
    """After imitation alone the agent has the teacher's actions, here always the same pair, and its title names it."""
    config = replace(TINY, total_steps=0, imitate={"teacher": "best_pair", "rounds": 2, "episodes": 3, "epochs": 60})
    path = train(NAME, "ppo", config, 0, tmp_path, SHORT)
    model = ALGORITHMS["ppo"].load(path)
    assert load_agent(path, path.read_bytes())[1] == "imitation of best_pair trained with seed 0"
    observation, _ = gym.make(NAME, **SHORT).reset(seed=2)
    assert int(model.predict(observation, deterministic=True)[0]) == 7


@pytest.mark.parametrize(("text", "message"), [
    ("- a\n", "must hold entries of"), ("steps: 3\n", "must hold entries of"), ("a: [", "config must be a YAML file"),
    ("n_envs: 2\n", "config .*config.yml' must hold total_steps"),
    ("total_steps: 1\nanneal: true\nalgorithm: fast\n", "algorithm must be a dict of names and values, got 'fast'"),
    ("total_steps: 1\nhidden: [8, x]\n", "each entry of hidden must be an integer of at least 1, got 'x'"),
    ("total_steps: 1\nanneal: 'no'\n", "anneal must be true or false, got 'no'"),
    ("total_steps: -1\n", "total_steps must"),
])
def test_invalid_configurations_are_reported(text, message, tmp_path):
    path = tmp_path / "config.yml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_config(path)


@pytest.mark.parametrize(("env", "algo", "change", "kwargs", "message"), [
    ("eitbench/Pipe2D-v0", "ppo", {}, {}, "env must be one of eitbench/Pipe2DInjection-v0"),
    (NAME, "reinforce", {}, {}, "algo must be one of ppo"),
    (NAME, "ppo", {"imitate": {"teacher": "event_triggered"}}, {},
     "imitate.teacher must be a policy that suits env, got 'event_triggered'"),
    (NAME, "ppo", {"imitate": {"teacher": "best_pair", "learning_rate": 0}}, {}, "imitate.learning_rate must be"),
    (NAME, "ppo", {"reference": "event_triggered"}, {}, "reference must be a policy that suits env"),
    (NAME, "ppo", {"algorithm": {"speed": 1, "seed": 2}}, {}, "algorithm must hold.*; got seed, speed"),
    (NAME, "sac", {}, {}, "sac is for actions that are currents, and env takes numbers"),
    (CURRENTS, "ppo", {"imitate": {"teacher": "best_pair"}}, {}, "imitate is for actions that are numbers"),
    (NAME, "ppo", {}, {"episodes": 3, "estimator": "full"}, "kwargs must not hold.*; got episodes, estimator"),
    (NAME, "ppo", {"algorithm": {"n_steps": 0}}, {}, "algorithm must hold valid arguments of ppo: "),
])
def test_invalid_arguments_are_reported_before_any_writing(env, algo, change, kwargs, message, tmp_path):
    """After a correction the same folder can be used."""
    with pytest.raises(ValueError, match=message):
        train(env, algo, replace(TINY, **({"algorithm": {}} | change)), 0, tmp_path, SHORT | kwargs)
    assert not list(tmp_path.iterdir())


def test_rewards_of_a_reference_are_subtracted():
    """Rewards of a policy in the same episodes are subtracted step by step, in this episode and the next."""
    world = gym.make(NAME, episodes=5, observation="raw", **SHORT).unwrapped
    reference = training.policy_rewards("best_pair", world)
    envs, plain = vector(5), vector(5)
    ours = InjectionVecEnv(envs, reward_scale=10.0, reference=reference)
    ours.seed(5)
    ours.reset()
    rng, best = np.random.default_rng(0), world.rules.pairs.tolist().index([0, 8])
    for _ in range(2):
        started, actions = list(envs.seeds), rng.integers(120, size=(6, 3))
        earned = []
        for chosen in (actions, np.full((6, 3), best)):
            plain.reset(seed=started)
            earned.append([plain.step(action)[1] for action in chosen])
        expected = 10.0 * np.subtract(*earned)
        assert np.abs(expected).max() > 1e-3
        np.testing.assert_allclose([ours.step(action)[1] for action in actions], expected, atol=1e-6)


@pytest.mark.parametrize(("algorithm", "policy"), [("ppo", PairPolicy), ("maskable_ppo", MaskablePairPolicy)])
@pytest.mark.parametrize("id", [NAME, "eitbench/TankReadings-v0"])
def test_an_agent_chooses_the_most_probable_pair(algorithm, policy, id):
    """`predict` returns the same action, for random observations and masks, also of the electrodes to measure."""
    env = gym.make(id, **world(id))
    model = ALGORITHMS[algorithm](policy, env, seed=4)
    rng = np.random.default_rng(1)
    actions = []
    for observation in rng.normal(size=(50, *model.observation_space.shape)).astype(np.float32):
        masks = ({"action_masks": rng.uniform(size=env.unwrapped.rules.action_masks(np.zeros(1, bool)).size) < 0.5}
                 if algorithm == "maskable_ppo" else {})
        actions.append(most_probable(model.policy, observation, **masks))
        np.testing.assert_array_equal(actions[-1], model.predict(observation, deterministic=True, **masks)[0])
    assert len({tuple(np.atleast_1d(action)) for action in actions}) > 5
