"""Train an injection agent with stable-baselines3, resuming from the last checkpoint.

A configuration is a YAML file such as the files of ``baselines/rl/``. A run writes to its folder
``config.json`` (its arguments), ``model.zip`` (the agent), ``sha256`` of the model, logs for
TensorBoard, and two files in the formats of stable-baselines3: ``K.monitor.csv`` with the training
episodes of its K-th start, whose returns have ``reward_scale`` and ``reference`` applied, and
``evaluations.npz`` with ``timesteps`` (k,), and with returns ``results``, ``ep_lengths`` and the
relative errors ``errors`` (k, episodes) on dev episodes, without discount.

Policies in a configuration (``reference``, ``imitate.teacher``) run in this process, without
isolation.

The episodes and noise of a resumed run differ from an uninterrupted run. A checkpoint holds the
networks and the optimisers, but not the replay buffers of dqn and sac, which start empty.
"""

from __future__ import annotations

import hashlib
import inspect
import io
import json
import sys
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from sb3_contrib import MaskablePPO, RecurrentPPO
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from eitbench import _check
from eitbench._files import resolve_input, write_atomically
from eitbench.data.presimulation import presimulate_if_writable
from eitbench.data.seeds import SPLITS
from eitbench.envs.injection import InjectionEnv, InjectionVectorEnv
from eitbench.rl.imitation import check_imitation, imitate, load_compatible_policy, rollout
from eitbench.rl.networks import MaskablePairPolicy, PairPolicy
from eitbench.rl.vec_env import InjectionVecEnv
from eitbench.worlds.registry import entries

ALGORITHMS: dict[str, type[BaseAlgorithm]] = {
    "ppo": PPO, "dqn": DQN, "sac": SAC, "recurrent_ppo": RecurrentPPO,
    "maskable_ppo": MaskablePPO}
RESERVED = {"policy", "env", "seed", "device", "tensorboard_log", "_init_setup_model"}
"""Arguments of the algorithms that `train` sets."""


@dataclass(frozen=True)
class TrainingConfig:
    """Entries of a configuration file."""

    total_steps: int
    """total steps of all environments; ppo finishes the rollout that reaches them"""
    n_envs: int = 16
    """number of parallel environments"""
    interval: int = 50_000
    """steps between checkpoints, at which the agent is also evaluated"""
    evaluation_episodes: int = 32
    """number of dev episodes in an evaluation"""
    episodes: int = 1000
    """number of training episodes"""
    reward_scale: float = 100.0
    """factor of the rewards"""
    hidden: tuple[int, ...] = (256, 256)
    """numbers of units of the networks' hidden layers"""
    anneal: bool = False
    """decrease the learning rate linearly to zero"""
    algorithm: dict[str, Any] = field(default_factory=dict)
    """further arguments of the algorithm in stable-baselines3"""
    reference: str = ""
    """name or path of a policy whose reward in the same episode is subtracted (reward baseline)"""
    imitate: dict[str, Any] = field(default_factory=dict)
    """arguments of imitation learning before reinforcement, e.g. ``teacher``; see `imitate`"""

    def __post_init__(self) -> None:
        for name in ("total_steps", "n_envs", "interval", "evaluation_episodes", "episodes"):
            _check.integer(name, getattr(self, name), low=0 if name == "total_steps" else 1)
        _check.number("reward_scale", self.reward_scale, low=0.0, open_low=True)
        for name, kind, words in (
                ("algorithm", dict, "a dict of names and values"),
                ("imitate", dict, "a dict of names and values"),
                ("hidden", (tuple, list), "a list of integers"),
                ("reference", str, "the name or path of a policy"),
                ("anneal", bool, "true or false")):
            if not isinstance(getattr(self, name), kind):
                raise ValueError(f"{name} must be {words}, got {getattr(self, name)!r}")
        for units in self.hidden:
            _check.integer("each entry of hidden", units, low=1)
        if self.anneal:
            _check.number("algorithm.learning_rate", self.algorithm.get("learning_rate"), low=0.0,
                          open_low=True)


def read_config(path: str | Path) -> TrainingConfig:
    """Read a YAML file; entries without a value have their default. The path of a built-in file,
    such as ``baselines/rl/ppo.yml``, may be relative to any working folder.

    ``ValueError`` for a missing file, and for an unknown or invalid entry.
    """
    import yaml
    try:
        content = yaml.safe_load(resolve_input(Path(path)).read_text())
    except (OSError, yaml.YAMLError) as error:
        raise ValueError(f"config must be a YAML file, got {str(path)!r}: {error}") from None
    known = TrainingConfig.__dataclass_fields__
    if not isinstance(content, dict) or not set(content) <= set(known):
        raise ValueError(
            f"config {str(path)!r} must hold entries of {', '.join(known)}; got {content!r}")
    if content.get("total_steps") is None:
        raise ValueError(f"config {str(path)!r} must hold total_steps, got {content!r}")
    given: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value
                             for name, value in content.items() if value is not None}
    return TrainingConfig(**given)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Limit BLAS and torch to one thread, since rounding depends on the number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        torch.set_num_threads(before)


@_one_thread()
def train(env: str, algo: str, config: TrainingConfig, seed: int, folder: Path,
          kwargs: dict[str, Any] | None = None) -> Path:
    """Train an agent; return the path of its model.

    Parameters
    ----------
    env : str
        Id of an injection environment.
    algo : str
        One of `ALGORITHMS`.
    config : TrainingConfig
    seed : int
        Random seed of the networks, the exploration and the choice of training episodes.
    folder : Path
        Folder of the run; an interrupted run with the same arguments is resumed.
    kwargs : dict, optional
        Arguments of the environment.
    """
    _check.choice("algo", algo, ALGORITHMS)
    seed = _check.integer("seed", seed, low=0)
    envs = vector_env(env, kwargs, config)
    asked = {"env": env, "kwargs": kwargs or {}, "algo": algo, "seed": seed,
             "config": asdict(config)}
    settings, made, latest = (folder / name for name in ("config.json", "model.zip", "latest.zip"))
    if settings.exists():
        there, here = (each | each.get("config", {}) for each in (
            json.loads(settings.read_text()), json.loads(json.dumps(asked))))
        if differ := [name for name in here if name != "config"
                      and there.get(name, "unknown") != here[name]]:
            found = ", ".join(f"{name} {there.get(name, 'unknown')}, not {here[name]}"
                              for name in differ)
            raise ValueError(f"out must be empty, or of the same run; {folder} has {found}")
    if made.exists() and (folder / "sha256").exists() and not latest.exists():
        return made
    world: Any = gym.make(env, disable_env_checker=True, observation="raw",
                          episodes=config.episodes, **(kwargs or {})).unwrapped
    _check_together(algo, config, world)
    inner = InjectionVecEnv(envs, reward_scale=config.reward_scale)
    learning = VecMonitor(inner)
    learning.seed(seed)
    is_new = not latest.exists()
    how: dict[str, Any] = {"device": "cpu", "tensorboard_log": str(folder / "tensorboard")}
    if is_new:
        model = _new_model(algo, config, learning, seed, how)
    else:
        model = ALGORITHMS[algo].load(latest, env=learning, **how)
        model.set_random_seed(seed + model.num_timesteps)  # loading restored the first seed
    # written after all cheap checks
    write_atomically(settings, json.dumps(asked, indent=1).encode())
    start = len(list(folder.glob("*.monitor.csv")))
    learning.results_writer = ResultsWriter(
        str(folder / f"{start}.monitor.csv"), header={"t_start": learning.t_start, "env_id": env})
    if config.reference or config.imitate:  # they run the training episodes one by one
        presimulate_if_writable(world.world, SPLITS["train"][:config.episodes])
    if config.reference:
        inner.reference = policy_rewards(config.reference, world)
    if is_new:
        if config.imitate:
            imitate(model, world, config.imitate, config.reward_scale, inner.reference, seed)
        save_model(model, latest)
    callback = _Checkpoints(folder, config.interval, make_evaluator(env, kwargs, config))
    if not (folder / "evaluations.npz").exists():
        callback.evaluate(model)
    if (left := config.total_steps - model.num_timesteps) > 0:
        model.learn(left, callback=callback, reset_num_timesteps=False, tb_log_name="run",
                    progress_bar=sys.stderr.isatty())
    _clear_optimisers(model)
    save_model(model, made)
    write_atomically(folder / "sha256", hashlib.sha256(made.read_bytes()).hexdigest().encode())
    latest.unlink()
    learning.close()
    return made


def vector_env(env: str, kwargs: dict[str, Any] | None, config: TrainingConfig,
               n_envs: int | None = None) -> InjectionVectorEnv:
    """Build the vector environment; ``ValueError`` if ``env`` is not an injection environment, or
    ``kwargs`` hold arguments that training sets."""
    _check.choice("env", env, [id for id, each in entries().items() if each.track == "injection"])
    if taken := {"episodes", "observation", "estimator"} & set(kwargs or {}):
        raise ValueError("kwargs must not hold episodes, an entry of the configuration, nor "
                         "observation and estimator, which training sets; "
                         f"got {', '.join(sorted(taken))}")
    made: Any = gym.make_vec(env, num_envs=n_envs or config.n_envs, episodes=config.episodes,
                             vectorization_mode="vector_entry_point", **(kwargs or {}))
    return made


def policy_rewards(policy: str, world: InjectionEnv) -> np.ndarray:
    """Compute the rewards (episodes, steps) of a policy in the training episodes."""
    method = load_compatible_policy("reference", policy, world.rules)
    return np.array([
        rollout(world, method, episode, np.random.default_rng(episode))[2]
        for episode in tqdm(range(world.pool.max_episodes), desc=f"rewards of {policy}",
                            unit="episode", disable=None)])


def make_evaluator(env: str, kwargs: dict[str, Any] | None,
                   config: TrainingConfig,
                   ) -> Callable[[BaseAlgorithm], tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return a function that computes ẽ_c, return and length of each of the first dev episodes for
    deterministic actions of a model, with the reduced filter."""
    seeds: Any = list(SPLITS["dev"])[:config.evaluation_episodes]
    envs = vector_env(env, kwargs, config, len(seeds))

    def evaluate(model: BaseAlgorithm) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        presimulate_if_writable(envs.world, seeds)
        observation, _ = envs.reset(seed=seeds)
        returns = np.zeros(len(seeds))
        state = None
        errors: list[np.ndarray] = []           # of scored states; some may be failed estimates
        length = envs.cores[0].length
        for k in range(length):
            how: Any = {"action_masks": envs.action_masks()} if isinstance(model, MaskablePPO) \
                else {}
            actions, state = model.predict(observation, state, np.full(len(seeds), k == 0),
                                           deterministic=True, **how)
            observation, rewards, _, _, info = envs.step(actions)
            returns += rewards
            if "error" in info:
                errors.append(info["error"])
        return np.mean(errors, axis=0), returns, np.full(len(seeds), length)

    return evaluate


def _check_together(algo: str, config: TrainingConfig, world: InjectionEnv) -> None:
    """Raise ``ValueError`` if algorithm, configuration and environment do not match."""
    numbered = world.rules.limit is None
    if algo in (("sac",) if numbered else ("dqn", "maskable_ppo")):
        asks, takes = ("currents", "numbers") if numbered else ("numbers", "currents")
        raise ValueError(
            f"algo must suit env: {algo} is for actions that are {asks}, and env takes {takes}")
    known = set(inspect.signature(ALGORITHMS[algo]).parameters) - RESERVED
    if unknown := set(config.algorithm) - known:
        raise ValueError(f"algorithm must hold arguments of {algo}, {', '.join(sorted(known))}; "
                         f"got {', '.join(sorted(map(str, unknown)))}")
    if config.reference:
        load_compatible_policy("reference", config.reference, world.rules)
    if config.imitate:
        check_imitation(algo, config.imitate, world.rules)


def _new_model(algo: str, config: TrainingConfig, learning: VecEnv, seed: int,
               how: dict[str, Any]) -> BaseAlgorithm:
    policy: Any = "MlpPolicy"
    if not isinstance(learning.action_space, spaces.Box):
        policy = {"ppo": PairPolicy, "maskable_ppo": MaskablePairPolicy,
                  "recurrent_ppo": "MlpLstmPolicy"}.get(algo, policy)
    arguments = {"policy_kwargs": {"net_arch": list(config.hidden)}} | config.algorithm
    if config.anneal:
        arguments["learning_rate"] = LinearSchedule(arguments["learning_rate"], 0.0, 1.0)
    try:
        return ALGORITHMS[algo](policy, learning, seed=seed, **how, **arguments)
    except (AssertionError, TypeError) as error:
        raise ValueError(f"algorithm must hold valid arguments of {algo}: {error}") from None


def save_model(model: BaseAlgorithm, path: Path) -> None:
    """Write a model as a compressed zip, atomically; stable-baselines3 does not compress it."""
    stored, content = io.BytesIO(), io.BytesIO()
    model.save(stored)
    with zipfile.ZipFile(stored) as source, zipfile.ZipFile(content, "w") as packed:
        for file in source.infolist():
            packed.writestr(file, source.read(file), zipfile.ZIP_DEFLATED, 9)
    write_atomically(path, content.getvalue())


def _clear_optimisers(model: BaseAlgorithm) -> None:
    """Clear the state of the optimisers, which is twice as large as the networks."""
    policy = model.policy
    for part in (policy, getattr(policy, "actor", None), getattr(policy, "critic", None)):
        if isinstance(optimiser := getattr(part, "optimizer", None), torch.optim.Optimizer):
            optimiser.state.clear()


class _Checkpoints(BaseCallback):
    """Callback that evaluates and stores the agent at every interval and at the end."""

    def __init__(self, folder: Path, interval: int,
                 evaluator: Callable[[BaseAlgorithm], tuple[np.ndarray, ...]]) -> None:
        super().__init__()
        self.folder = folder
        self.interval = interval
        self.evaluator = evaluator

    def _on_training_start(self) -> None:
        self._next = (self.num_timesteps // self.interval + 1) * self.interval

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next:
            self._next += self.interval
            self._on_training_end()
        return True

    def _on_training_end(self) -> None:
        errors, returns = self.evaluate(self.model)
        self.logger.record("eval/relative_error", float(errors.mean()))
        self.logger.record("eval/mean_reward", float(returns.mean()))
        save_model(self.model, self.folder / "latest.zip")

    def evaluate(self, model: BaseAlgorithm) -> tuple[np.ndarray, np.ndarray]:
        """Append errors and returns (episodes,) to the table, and remove rows of the same or a
        larger number of steps, which belong to lost checkpoints."""
        errors, returns, lengths = self.evaluator(model)
        row: dict[str, Any] = {"timesteps": model.num_timesteps, "results": returns,
                               "ep_lengths": lengths, "errors": errors}
        path = self.folder / "evaluations.npz"
        rows: dict[str, Any] = {name: [value] for name, value in row.items()}
        if path.exists():
            table = np.load(path)
            kept = table["timesteps"] < model.num_timesteps
            rows = {name: [*table[name][kept], value] for name, value in row.items()}
        content = io.BytesIO()
        np.savez(content, **rows)
        write_atomically(path, content.getvalue())
        return errors, returns
