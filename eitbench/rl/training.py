"""Train an agent to choose injections with stable-baselines3; it resumes from its last checkpoint.

A configuration is a YAML file such as those in ``baselines/rl/``. A run leaves in its folder:
``config.json`` (what was asked for), ``model.zip`` (the agent), ``monitor.csv`` (one row a training
episode), ``evaluations.npz`` (scores on dev episodes over time), ``sha256`` of the model, and
TensorBoard's logs.

Policies that a configuration names (``reference``, ``imitate.teacher``) run in this process,
without isolation.

A run that goes on draws other episodes and other noise than it did before. A checkpoint holds the
networks and the optimisers, not what dqn and sac have gathered in their replay buffers: these go on
with an empty one.
"""

from __future__ import annotations

import hashlib
import inspect
import io
import json
import time
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
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from eitbench import _check
from eitbench._files import readable, write_atomically
from eitbench.bench.methods import load_method
from eitbench.data.cache import npy
from eitbench.data.seeds import SPLITS
from eitbench.envs.injection import InjectionEnv, InjectionVectorEnv
from eitbench.rl.imitation import check_imitation, imitate, suited
from eitbench.rl.networks import MaskablePairPolicy, PairPolicy
from eitbench.rl.vec_env import InjectionVecEnv
from eitbench.worlds.registry import entries, entry

_CLASSES = {"ppo": PPO, "dqn": DQN, "sac": SAC, "recurrent_ppo": RecurrentPPO,
            "maskable_ppo": MaskablePPO}
ALGORITHMS = tuple(_CLASSES)
OURS = {"policy", "env", "seed", "device", "tensorboard_log", "_init_setup_model"}
"""Arguments of the algorithms that no configuration has a say in."""


@dataclass(frozen=True)
class Config:
    """What a configuration file may say."""

    total_steps: int
    """environment steps of all environments together; ppo finishes the rollout that reaches them"""
    n_envs: int = 16
    """environments side by side"""
    interval: int = 50_000
    """steps between two checkpoints, at which the agent is evaluated too"""
    evaluation_episodes: int = 32
    """dev episodes of an evaluation"""
    episodes: int = 1000
    """training episodes"""
    reward_scale: float = 100.0
    """factor of the rewards"""
    hidden: tuple[int, ...] = (256, 256)
    """units of the networks' hidden layers"""
    anneal: bool = False
    """whether the learning rate falls linearly to zero"""
    algorithm: dict[str, Any] = field(default_factory=dict)
    """passed on to stable-baselines3"""
    reference: str = ""
    """name or path of a policy; rewards are counted from what it earns in the same episode"""
    imitate: dict[str, Any] = field(default_factory=dict)
    """what to learn from before reinforcement: ``teacher``, …; see `eitbench.rl.imitation`"""

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


def read_config(path: str | Path) -> Config:
    """The configuration in a YAML file, where an entry without a value is the default; one of ours,
    such as ``baselines/rl/ppo.yml``, is found from any folder.

    ``ValueError`` if there is none, or an entry is unknown or wrong.
    """
    import yaml
    try:
        content = yaml.safe_load(readable(Path(path)).read_text())
    except (OSError, yaml.YAMLError) as error:
        raise ValueError(f"config must be a YAML file, got {str(path)!r}: {error}") from None
    known = Config.__dataclass_fields__
    if not isinstance(content, dict) or not set(content) <= set(known):
        raise ValueError(
            f"config {str(path)!r} must hold entries of {', '.join(known)}; got {content!r}")
    said: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value
                            for name, value in content.items() if value is not None}
    try:
        return Config(**said)
    except (TypeError, AttributeError) as error:
        raise ValueError(
            f"config {str(path)!r} must hold what `Config` asks for: {error}") from None


@contextmanager
def _one_thread() -> Iterator[None]:
    """Limit BLAS and torch to one thread: with more, rounding depends on their number."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        torch.set_num_threads(before)


@_one_thread()
def train(env: str, algo: str, config: Config, seed: int, folder: Path,
          kwargs: dict[str, Any] | None = None) -> Path:
    """Train an agent; returns the path of its model.

    Parameters
    ----------
    env : str
        Id of an injection environment.
    algo : str
        One of `ALGORITHMS`.
    config : Config
    seed : int
        Of the networks, the exploration and the choice of training episodes.
    folder : Path
        Where the run is kept; a run that was begun there with the same arguments is continued.
    kwargs : dict, optional
        Of the environment.
    """
    if algo not in ALGORITHMS:
        raise ValueError(f"algo must be one of {', '.join(ALGORITHMS)}, got {algo!r}")
    seed = _check.integer("seed", seed, low=0)
    envs = vector_env(env, kwargs, config)
    asked = {"env": env, "kwargs": kwargs or {}, "algo": algo, "seed": seed,
             "config": asdict(config)}
    _compare(folder, asked)
    made = folder / "model.zip"
    latest = folder / "latest.zip"
    if made.exists() and (folder / "sha256").exists() and not latest.exists():
        return made
    world = gym.make(env, disable_env_checker=True, observation="raw", episodes=config.episodes,
                     **(kwargs or {})).unwrapped
    assert isinstance(world, InjectionEnv)
    _check_together(algo, config, world)
    inner = InjectionVecEnv(envs, reward_scale=config.reward_scale)
    learning = VecMonitor(inner)
    learning.seed(seed)
    begins = not latest.exists()
    how = {"device": "cpu", "tensorboard_log": str(folder / "tensorboard")}
    if begins:
        model = _fresh(algo, config, learning, seed, how)
    else:
        model = algorithm_of(algo).load(latest, env=learning, **how)
        model.set_random_seed(seed + model.num_timesteps)  # loading seeded it as at the beginning
    # From here on the folder belongs to this run: all that is cheap to check has been tried.
    write_atomically(folder / "config.json", json.dumps(asked, indent=1).encode())
    if config.reference:
        inner.reference = rewards_of(config.reference, world, folder / "reference.npy")
    if begins:
        if config.imitate:
            assert isinstance(model, OnPolicyAlgorithm)
            imitate(model, world, config.imitate, config.reward_scale, inner.reference, seed)
        _save(model, latest)
    evaluate = evaluation(env, kwargs, config)
    left = config.total_steps - model.num_timesteps
    if not (folder / "evaluations.npz").exists():
        _append_evaluation(folder, model.num_timesteps, evaluate(model))
    if left > 0:
        model.learn(left, callback=_Checkpoints(folder, config, evaluate),
                    reset_num_timesteps=False, tb_log_name="run")
    _forget(model)
    _save(model, made)
    write_atomically(folder / "sha256", hashlib.sha256(made.read_bytes()).hexdigest().encode())
    latest.unlink()
    (folder / "reference.npy").unlink(missing_ok=True)
    return made


def vector_env(env: str, kwargs: dict[str, Any] | None, config: Config,
               n_envs: int | None = None) -> InjectionVectorEnv:
    """The environments side by side; ``ValueError`` if ``env`` does not ask for injections, or
    ``kwargs`` hold what training itself decides."""
    if entry(env).track != "injection":
        asks = [id for id, each in entries().items() if each.track == "injection"]
        raise ValueError(f"env must be one of {', '.join(asks)}; got {env!r}")
    if taken := {"episodes", "observation", "estimator"} & set(kwargs or {}):
        raise ValueError("kwargs must not hold episodes, which the configuration says, nor "
                         "observation and estimator, which training decides; "
                         f"got {', '.join(sorted(taken))}")
    made = gym.make_vec(env, num_envs=n_envs or config.n_envs, episodes=config.episodes,
                        vectorization_mode="vector_entry_point", **(kwargs or {}))
    assert isinstance(made, InjectionVectorEnv)
    return made


def rewards_of(policy: str, world: InjectionEnv, path: Path) -> np.ndarray:
    """(episodes, steps) what a policy earns in every training episode; kept at ``path``."""
    if path.exists():
        return np.asarray(np.load(path))
    rewards = np.zeros((world.pool.most, world.core.length))
    loaded = load_method(policy, "injection")
    for episode in tqdm(range(world.pool.most), desc=f"playing {policy}", unit="episode",
                        disable=None):
        observation, _ = world.reset(seed=episode)
        random = np.random.default_rng(episode)
        player = loaded.make(world.rules, random, *[world.core] * loaded.privileged)
        for k in range(world.core.length):
            observation, rewards[episode, k], *_ = world.step(player.act(observation))
    write_atomically(path, npy(rewards))
    return rewards


def algorithm_of(name: str) -> Any:
    """The class of one of `ALGORITHMS`."""
    return _CLASSES[name]


def evaluation(env: str, kwargs: dict[str, Any] | None,
               config: Config) -> Callable[[BaseAlgorithm], np.ndarray]:
    """A function that gives the ẽ_c of a model's deterministic actions in each of the first dev
    episodes, with the filter of reduced order."""
    envs = vector_env(env, kwargs, config, config.evaluation_episodes)
    seeds = list(SPLITS["dev"])[:config.evaluation_episodes]

    def evaluate(model: BaseAlgorithm) -> np.ndarray:
        observation: Any = envs.reset(seed=seeds)[0]  # type: ignore[arg-type]
        how: dict[str, Any] = {"deterministic": True, "state": None}
        starts = np.ones(len(seeds), dtype=bool)
        errors = []
        ended = False
        while not ended:
            if isinstance(model, MaskablePPO):
                how["action_masks"] = envs.action_masks()
            actions, how["state"] = model.predict(observation, episode_start=starts, **how)
            starts = np.zeros(len(seeds), dtype=bool)
            observation, _, done, _, _ = envs.step(actions)
            errors.append(envs.errors())
            ended = bool(done.all())
        # States that are not scored are of no episode; an estimate that is not finite must not pass
        # for one of them.
        scored = np.array([row for row in errors if not np.isnan(row).all()])
        return scored.mean(axis=0)

    return evaluate


def _compare(folder: Path, asked: dict[str, Any]) -> None:
    """``ValueError`` if another run is kept in the folder."""
    path = folder / "config.json"
    if path.exists() and (there := json.loads(path.read_text())) != json.loads(json.dumps(asked)):
        raise ValueError(
            f"out must be an empty folder or one of the same run; {folder} holds {there}")


def _check_together(algo: str, config: Config, world: InjectionEnv) -> None:
    """``ValueError`` if algorithm, configuration and environment do not go together."""
    numbered = isinstance(world.action_space, spaces.Discrete)
    if algo in (("sac",) if numbered else ("dqn", "maskable_ppo")):
        asks, takes = ("currents", "numbers") if numbered else ("numbers", "currents")
        raise ValueError(
            f"algo must suit env: {algo} is for actions that are {asks}, and env takes {takes}")
    known = set(inspect.signature(algorithm_of(algo)).parameters) - OURS
    if unknown := set(config.algorithm) - known:
        raise ValueError(f"algorithm must hold arguments of {algo}, {', '.join(sorted(known))}; "
                         f"got {', '.join(sorted(map(str, unknown)))}")
    if config.reference:
        suited("reference", config.reference, world.rules)
    if config.imitate:
        check_imitation(algo, config.imitate, world.rules)


def _fresh(algo: str, config: Config, learning: VecEnv, seed: int,
           how: dict[str, Any]) -> BaseAlgorithm:
    policy: Any = "MlpPolicy"
    if isinstance(learning.action_space, spaces.Discrete):
        policy = {"ppo": PairPolicy, "maskable_ppo": MaskablePairPolicy,
                  "recurrent_ppo": "MlpLstmPolicy"}.get(algo, policy)
    arguments = {"policy_kwargs": {"net_arch": list(config.hidden)}} | config.algorithm
    if config.anneal:
        arguments["learning_rate"] = LinearSchedule(arguments["learning_rate"], 0.0, 1.0)
    try:
        made: BaseAlgorithm = algorithm_of(algo)(policy, learning, seed=seed, **how, **arguments)
    except (AssertionError, TypeError) as error:
        raise ValueError(f"algorithm must hold what {algo} takes: {error}") from None
    return made


def _save(model: BaseAlgorithm, path: Path) -> None:
    content = io.BytesIO()
    model.save(content)
    write_atomically(path, _compressed(content))


def _compressed(archive: io.BytesIO) -> bytes:
    """The same files in a zip that is smaller: stable-baselines3 stores them as they are."""
    content = io.BytesIO()
    with zipfile.ZipFile(archive) as stored, zipfile.ZipFile(content, "w") as packed:
        for file in stored.infolist():
            packed.writestr(file, stored.read(file), zipfile.ZIP_DEFLATED, 9)
    return content.getvalue()


def _forget(model: BaseAlgorithm) -> None:
    """Let go of what the optimisers remember, twice as much as the networks hold."""
    policy = model.policy
    for part in (policy, getattr(policy, "actor", None), getattr(policy, "critic", None)):
        if isinstance(optimiser := getattr(part, "optimizer", None), torch.optim.Optimizer):
            optimiser.state.clear()


def _append_evaluation(folder: Path, steps: int, errors: np.ndarray) -> None:
    """One row more; rows of as many steps or more are of a checkpoint not kept, or of this."""
    path = folder / "evaluations.npz"
    before = {"steps": np.zeros(0, int), "errors": np.zeros((0, len(errors)))}
    if path.exists():
        before = dict(np.load(path))
    kept = before["steps"] < steps
    content = io.BytesIO()
    np.savez(content, steps=np.append(before["steps"][kept], steps),
             errors=np.vstack([before["errors"][kept], errors]))
    write_atomically(path, content.getvalue())


def _forget_beyond(monitor: Path, steps: int) -> None:
    """Keep the rows up to so many steps: later ones, of a checkpoint not kept, come again."""
    rows = monitor.read_text().splitlines(keepends=True)[1:] if monitor.exists() else []
    kept = [row for row in rows if row.endswith("\n") and int(row.split(",")[0]) <= steps]
    write_atomically(monitor, "".join(["steps,return,length,seconds\n", *kept]).encode())


class _Checkpoints(BaseCallback):
    """Every interval a checkpoint and an evaluation, every episode a row of ``monitor.csv``."""

    def __init__(self, folder: Path, config: Config,
                 evaluate: Callable[[BaseAlgorithm], np.ndarray]) -> None:
        super().__init__()
        self.folder = folder
        self.config = config
        self.evaluate = evaluate

    def _on_training_start(self) -> None:
        self._bar = tqdm(total=self.config.total_steps, initial=self.num_timesteps,
                         desc=self.folder.name, unit="step", disable=None)
        self._next = (self.num_timesteps // self.config.interval + 1) * self.config.interval
        self._rows: list[str] = []
        self._begin = time.monotonic()
        _forget_beyond(self.folder / "monitor.csv", self.num_timesteps)

    def _on_step(self) -> bool:
        self._bar.update(self.num_timesteps - self._bar.n)
        for info in self.locals["infos"]:
            if played := info.get("episode"):
                earned = played["r"] / self.config.reward_scale
                self._rows.append(f"{self.num_timesteps},{earned:.6f},{played['l']},"
                                  f"{time.monotonic() - self._begin:.1f}\n")
        if self.num_timesteps >= self._next:
            self._next += self.config.interval
            self._keep()
        return True

    def _on_training_end(self) -> None:
        self._keep()
        self._bar.close()

    def _keep(self) -> None:
        errors = self.evaluate(self.model)
        self.logger.record("eval/relative_error", float(errors.mean()))
        _append_evaluation(self.folder, self.num_timesteps, errors)
        with (self.folder / "monitor.csv").open("a") as file:
            file.writelines(self._rows)
        self._rows.clear()
        _save(self.model, self.folder / "latest.zip")

