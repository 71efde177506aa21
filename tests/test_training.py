"""Training with stable-baselines3: what is learnt from is what the environments show, and nothing is lost."""

import json
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from eitbench import training
from eitbench.envs.injection_core import Rules
from eitbench.envs.sb3 import InjectionVecEnv
from eitbench.leaderboard.policies import load_policy, play
from eitbench.scenarios import Pipe2D
from eitbench.training import Config, read_config, train

NAME = "eitbench/Pipe2DInjection-v0"
CURRENTS, BUDGET = "eitbench/Pipe2DInjectionCurrents-v0", "eitbench/Pipe2DInjectionBudget-v0"
SHORT = {"scenario": {"scored_steps": 4, "mean_velocity": 16.0}}
"""Four steps of the agent an episode."""
TINY = Config(total_steps=32, n_envs=2, interval=16, evaluation_episodes=2, episodes=3, hidden=(8,),
              algorithm={"n_steps": 8, "batch_size": 8})


def test_sb3_sees_what_the_environments_show():
    """Step by step the observations and rewards of single environments, over an episode's end; rewards scaled."""
    envs = gym.make_vec(NAME, num_envs=3, vectorization_mode="vector_entry_point", episodes=3, **SHORT)
    ours = InjectionVecEnv(envs, reward_scale=10.0)
    ours.seed(5)
    shown = ours.reset()
    played = [int(k) for k in np.random.default_rng(5).integers(3, size=3)]
    single = [gym.make(NAME, episodes=3, **SHORT) for _ in range(3)]
    expected = [env.reset(seed=k)[0] for env, k in zip(single, played, strict=True)]
    np.testing.assert_array_equal(shown, expected)
    rng = np.random.default_rng(0)
    for step in range(1, 6):
        actions = rng.integers(120, size=3)
        shown, rewards, ended, infos = ours.step(actions)
        outcome = [env.step(int(action)) for env, action in zip(single, actions, strict=True)]
        np.testing.assert_allclose(rewards, [10.0 * each[1] for each in outcome], rtol=1e-6)
        assert ended.all() == (step == 4) == outcome[0][2]
        if step == 4:
            np.testing.assert_array_equal([info["terminal_observation"] for info in infos], [e[0] for e in outcome])
            np.testing.assert_array_equal(shown, [env.reset()[0] for env in single])
        else:
            np.testing.assert_array_equal(shown, [each[0] for each in outcome])


@pytest.mark.parametrize(("env", "algo", "options"), [
    (NAME, "ppo", {"n_steps": 8, "batch_size": 8}), (BUDGET, "maskable_ppo", {"n_steps": 8, "batch_size": 8}),
    (NAME, "recurrent_ppo", {"n_steps": 8, "batch_size": 8}), (NAME, "dqn", {"learning_starts": 4, "train_freq": 4}),
    (CURRENTS, "sac", {"learning_starts": 4, "batch_size": 4}),
])
def test_every_algorithm_leaves_a_whole_run(env, algo, options, tmp_path):
    """Model, configuration, monitor, evaluations that are the model's own, and a checksum."""
    path = train(env, algo, replace(TINY, algorithm=options), 1, tmp_path, SHORT)
    model = training.algorithm_of(algo).load(path)
    assert 32 <= model.num_timesteps < 48
    kept = np.load(tmp_path / "evaluations.npz")
    assert kept["steps"][0] == 0 and (np.diff(kept["steps"]) >= 0).all() and kept["steps"][-1] == model.num_timesteps
    np.testing.assert_allclose(kept["errors"][-1], training.evaluation(env, SHORT, TINY)(model), rtol=1e-6)
    rows = (tmp_path / "monitor.csv").read_text().splitlines()
    assert rows[0] == "steps,return,length,seconds" and len(rows) - 1 == model.num_timesteps // 4
    assert json.loads((tmp_path / "config.json").read_text())["algo"] == algo
    assert not (getattr(model.policy, "actor", None) or model.policy).optimizer.state
    assert len((tmp_path / "sha256").read_text()) == 64 and not (tmp_path / "latest.zip").exists()


def test_a_killed_run_loses_no_more_than_an_interval(tmp_path, monkeypatch):
    """It goes on from its last checkpoint to the full number of steps, and its records go on too."""
    keep, calls = training._Checkpoints._keep, []

    def kill(self):
        keep(self)
        calls.append(self.num_timesteps)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(training._Checkpoints, "_keep", kill)
        with pytest.raises(KeyboardInterrupt):
            train(NAME, "ppo", TINY, 1, tmp_path, SHORT)
    assert calls == [16]
    model = training.algorithm_of("ppo").load(train(NAME, "ppo", TINY, 1, tmp_path, SHORT))
    assert model.num_timesteps == 32
    assert np.load(tmp_path / "evaluations.npz")["steps"].tolist() == [0, 16, 32, 32]
    with pytest.raises(ValueError, match="out must be an empty folder or one of the same run"):
        train(NAME, "ppo", TINY, 2, tmp_path, SHORT)


def test_the_same_seed_learns_the_same(tmp_path):
    """Two runs end with the same networks, another seed with others."""
    def networks(seed, name):
        model = training.algorithm_of("ppo").load(train(NAME, "ppo", TINY, seed, tmp_path / name, SHORT))
        return np.concatenate([p.detach().numpy().ravel() for p in model.policy.parameters()])
    first, again, other = networks(1, "a"), networks(1, "b"), networks(2, "c")
    assert (first == again).all() and (first != other).any()


def test_a_pupil_learns_what_its_teacher_says(tmp_path):
    """After imitation alone the agent does what the teacher does: here always the same pair."""
    config = replace(TINY, total_steps=0, imitate={"teacher": "best_pair", "rounds": 2, "episodes": 3, "epochs": 60})
    model = training.algorithm_of("ppo").load(train(NAME, "ppo", config, 0, tmp_path, SHORT))
    observation, _ = gym.make(NAME, **SHORT).reset(seed=2)
    assert int(model.predict(observation, deterministic=True)[0]) == 7


@pytest.mark.parametrize(("text", "message"), [
    ("- a\n", "must hold entries of"), ("steps: 3\n", "must hold entries of"), ("a: [", "config must be a YAML file"),
    ("total_steps: -1\n", "total_steps must"), ("total_steps: 1\nreward_scale: 0\n", "reward_scale must"),
])
def test_wrong_configurations_are_named(text, message, tmp_path):
    """A wrong file is named before anything is trained."""
    path = tmp_path / "config.yml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_config(path)


def test_wrong_arguments_are_named(tmp_path):
    """Environments without injections, and algorithms there are none of."""
    with pytest.raises(ValueError, match="env must be one of eitbench/Pipe2DInjection-v0"):
        train("eitbench/Pipe2D-v0", "ppo", TINY, 0, tmp_path)
    with pytest.raises(ValueError, match="algo must be one of ppo"):
        train(NAME, "reinforce", TINY, 0, tmp_path)
    with pytest.raises(ValueError, match="imitate must hold teacher"):
        train(NAME, "ppo", replace(TINY, imitate={"rounds": 1}), 0, tmp_path, SHORT)


def test_rewards_may_be_counted_from_others(tmp_path):
    """What a policy earns in the same episodes is taken away, step by step, in this episode and the next."""
    world = gym.make(NAME, episodes=5, observation="raw", **SHORT).unwrapped
    reference = training.rewards_of("best_pair", world, tmp_path / "reference.npy")
    envs, plain = (gym.make_vec(NAME, num_envs=3, vectorization_mode="vector_entry_point", episodes=5, **SHORT)
                   for _ in range(2))
    ours = InjectionVecEnv(envs, reward_scale=10.0, reference=reference)
    ours.seed(5)
    ours.reset()
    rng, best = np.random.default_rng(0), world.rules.pairs.tolist().index([0, 8])
    for _ in range(2):
        playing, actions = list(envs.seeds), rng.integers(120, size=(4, 3))
        earned = []
        for chosen in (actions, np.full((4, 3), best)):
            plain.reset(seed=playing)
            earned.append([plain.step(action)[1] for action in chosen])
        expected = 10.0 * np.subtract(*earned)
        assert np.abs(expected).max() > 1e-3
        np.testing.assert_allclose([ours.step(action)[1] for action in actions], expected, atol=1e-6)
    np.testing.assert_array_equal(training.rewards_of("random_pair", world, tmp_path / "reference.npy"), reference)


@pytest.mark.parametrize(("env", "algo"), [(NAME, "ppo"), (BUDGET, "maskable_ppo"), (CURRENTS, "sac"),
                                           (NAME, "recurrent_ppo")])
def test_an_agent_plays_as_it_was_evaluated(env, algo, tmp_path):
    """As a policy its errors are those of the last evaluation; a file that was changed is not opened."""
    options = {"learning_starts": 4, "batch_size": 4} if algo == "sac" else {"n_steps": 8, "batch_size": 8}
    kwargs = SHORT | ({"budget": 2} if env == BUDGET else {})
    path = train(env, algo, replace(TINY, algorithm=options), 1, tmp_path, kwargs)
    expected = np.load(tmp_path / "evaluations.npz")["errors"][-1]
    errors = [play(env, kwargs, str(path), seed, "reduced")["error"] for seed in (100_000, 100_001)]
    np.testing.assert_allclose(errors, expected, rtol=1e-5)
    agent = load_policy(str(path))
    injected = []
    for estimator in ("reduced", "full"):
        world = gym.make(env, estimator=estimator, observation="raw", **kwargs).unwrapped
        player, ended = agent.policy(world.rules, np.random.default_rng(0)), False
        observation, _ = world.reset(seed=7)
        injected.append([])
        while not ended:
            observation, _, ended, _, _ = world.step(player.act(observation))
            injected[-1].append(observation["currents"])
    np.testing.assert_array_equal(*injected)                # whichever filter is inside
    assert agent.name == f"{algo}_seed1" and not agent.privileged and agent.parameters["env"] == env
    assert not agent.suits(Rules(Pipe2D(), limit=None if env == CURRENTS else "L1"))
    path.write_bytes(path.read_bytes() + b"x")
    with pytest.raises(ValueError, match="must have the sha256 that lies beside it"):
        load_policy(str(path))
    (tmp_path / "sha256").unlink()
    with pytest.raises(ValueError, match="must lie beside the config"):
        load_policy(str(path))
