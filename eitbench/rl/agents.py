"""Trained agents as policies, loaded from the folder that `eitbench train` writes."""

from __future__ import annotations

import hashlib
import io
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from eitbench._files import write_atomically
from eitbench.bench.methods import baseline_folder
from eitbench.envs.injection_core import InjectionCore, flatten_scaled
from eitbench.estimation.onboard.full_filters import filters_class
from eitbench.estimation.onboard.rules import Rules
from eitbench.worlds.registry import entry


class AgentPolicy:
    """Base class of policies that observe what an agent observed in training.

    A scored run gives a policy a raw observation, with the estimates of the full filter. `act`
    replaces it by the scaled observation (d,) float32 of the environment in which the agent was
    trained, with its filter, and passes it to `choose`, which subclasses define. Injections so do
    not depend on the filter of the environment. ``random`` is for policies that draw actions.
    """

    estimator: ClassVar[str] = "reduced"
    """Filter of the environment in which the agent was trained: "reduced" or "full"."""
    gains: ClassVar[bool] = False
    """True if its observations had the gains of all pairs."""

    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        self.rules = replace(rules, gains=self.gains)
        self.random = random
        self._filters: Any = None

    def choose(self, observation: np.ndarray, mask: np.ndarray) -> Any:
        """Return the action for a scaled observation (d,); ``mask`` (n,) bool marks the allowed
        ones of n numbered actions, of each component in turn (empty if actions are currents)."""
        raise NotImplementedError

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        """Return the action for a raw observation."""
        if self._filters is None:
            kind = filters_class(self.rules, self.estimator)
            assert kind is not None
            self._filters = kind(self.rules, observation["frame"][None])
        else:
            self._filters.assimilate(observation["voltages"][None], observation["currents"][None])
        features = self._filters.features()
        observation = observation | {name: array[0] for name, array in features.items()}
        mask = np.ones(0, dtype=bool)
        if self.rules.limit is None:
            is_spent = self.rules.budget is not None and observation["left"][1] == 0.0
            (mask,) = self.rules.action_masks(np.array([is_spent]))
        return self.choose(flatten_scaled(self.rules, observation), mask)


class _ModelPolicy(AgentPolicy):
    """Policy of the deterministic actions of a stable-baselines3 model, which subclasses set."""

    model: ClassVar[Any]
    uses_action_masks: ClassVar[bool]

    @classmethod
    def suits(cls, rules: Rules) -> bool:
        """Return whether spaces have the shapes with which the model was trained."""
        if cls.gains and not rules.tracks_body:
            return False
        core = InjectionCore(replace(rules, gains=cls.gains), cls.estimator, "scaled")
        return bool(cls.model.action_space == core.action_space
                    and cls.model.observation_space.shape == core.observation_space.shape)

    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        super().__init__(rules, random)
        self._hidden_state = None
        self._is_first = True

    def choose(self, observation: np.ndarray, mask: np.ndarray) -> Any:
        # lazy import: other policies do not need torch
        from eitbench.rl.networks import MaskablePairPolicy, PairPolicy, most_probable
        masks = {"action_masks": mask} if self.uses_action_masks else {}
        if isinstance(self.model.policy, PairPolicy | MaskablePairPolicy):
            return most_probable(self.model.policy, observation, **masks)
        action, self._hidden_state = self.model.predict(
            observation, state=self._hidden_state, episode_start=np.array([self._is_first]),
            deterministic=True, **masks)
        self._is_first = False
        return action


def save_agent(model: Any, env: Any, folder: str | Path) -> Path:
    """Write a trained stable-baselines3 model as an agent, for ``eitbench run --policy`` and
    ``submit``; return the path of its ``model.zip``.

    Parameters
    ----------
    model : BaseAlgorithm
        Of a class in `eitbench.rl.training.ALGORITHMS`: PPO, DQN, SAC, RecurrentPPO, MaskablePPO.
    env : str or environment
        Id of the injection environment, or the environment (of Gymnasium or stable-baselines3) in
        which the model was trained, with its arguments.
    folder : str or Path
        Gets ``model.zip``, ``config.json`` and ``sha256``, the digest of the model. Agents in
        folders whose names differ in the final number only are trainings of one agent.

    Raises
    ------
    ValueError
        If the model is of another class, or was not trained with scaled observations and actions
        of this environment, or with a wrapper that normalises observations.
    """
    import gymnasium as gym
    from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

    from eitbench.rl.training import ALGORITHMS, save_model
    algo = next((name for name, each in ALGORITHMS.items() if type(model) is each), None)
    if algo is None:
        raise ValueError("model must be of one of the classes "
                         f"{', '.join(each.__name__ for each in ALGORITHMS.values())}, got "
                         f"{type(model).__name__}; for others write a policy file with AgentPolicy")
    spec = (gym.spec(env) if isinstance(env, str)
            else env.get_attr("spec")[0] if isinstance(env, VecEnv) else getattr(env, "spec", None))
    if spec is None or entry(spec.id).track != "injection":
        raise ValueError("env must be the id of an injection environment, or such an environment "
                         f"of gym.make or gym.make_vec, got {env!r}")
    for vector in filter(None, (model.get_env(), env if isinstance(env, VecEnv) else None)):
        if (((normalised := unwrap_vec_normalize(vector)) is not None and normalised.norm_obs)
                or any(vector.env_is_wrapped(gym.wrappers.NormalizeObservation))):
            raise ValueError("model must be trained with scaled observations, got normalised ones")
    kwargs = {name: value for name, value in spec.kwargs.items()
              if name in ("variant", "world", "gate", "inflow", "faults", "history", "gains",
                          "estimator")}
    core: Any = gym.make(spec.id, disable_env_checker=True, **kwargs).unwrapped
    for name in ("observation_space", "action_space"):
        expected, got = getattr(core, name), getattr(model, name)
        is_box = isinstance(expected, gym.spaces.Box)
        if expected.shape != got.shape if is_box else expected != got:
            raise ValueError(f"model must have the {name} of {spec.id} with scaled observations, "
                             f"{expected}, got {got}")
    folder = Path(folder)
    name = re.sub(r"[_-]?(seed)?\d*$", "", folder.resolve().name)      # of all trainings
    settings = {"env": spec.id, "kwargs": kwargs, "algo": algo, "seed": model.seed or 0,
                "name": name, "config": {"total_steps": int(model.num_timesteps)}}
    path = folder / "model.zip"
    save_model(model, path)
    write_atomically(folder / "config.json", json.dumps(settings, indent=1).encode())
    write_atomically(folder / "sha256", hashlib.sha256(path.read_bytes()).hexdigest().encode())
    return path


def load_agent(path: Path, content: bytes) -> tuple[str, str, type[AgentPolicy], dict[str, Any]]:
    """Return name, title, policy and parameters of the model.zip at ``path`` with this ``content``.

    The name is ALGO_seedK for built-in agents, and ALGO_HASH_seedK, with a hash of the
    configuration, for all others. Loading a model executes code, so its digest is first compared
    with ``sha256`` in the folder. ``ValueError`` if it differs, or if ``config.json`` or ``sha256``
    is missing.
    """
    try:
        asked = json.loads((path.parent / "config.json").read_text())
        expected = (path.parent / "sha256").read_text().split()[0]
    except (OSError, ValueError, IndexError) as error:
        raise ValueError(f"policy {path} must be in a folder with the config.json and sha256 that "
                         "`eitbench train` and eitbench.rl.save_agent(model, env, folder) write: "
                         f"{error}") from None
    found = hashlib.sha256(content).hexdigest()
    if found != expected:
        raise ValueError(f"policy {path} must have the sha256 of its folder, {expected}, got "
                         f"{found}")
    from eitbench.rl.training import ALGORITHMS
    algo, seed = asked["algo"], asked["seed"]
    try:
        model = ALGORITHMS[algo].load(io.BytesIO(content), device="cpu")
    except Exception as error:
        raise ValueError(f"policy {path} must be a model of the algorithm {algo}") from error
    policy = type("Policy", (_ModelPolicy,), {
        "model": model, "uses_action_masks": algo.startswith("maskable"),
        "estimator": asked.get("kwargs", {}).get("estimator", "reduced"),
        "gains": asked.get("kwargs", {}).get("gains", False)})
    built_in = (baseline_folder() / "checkpoints" / asked["env"].replace("/", "-") / algo
                / f"seed{seed}" / "sha256")             # a copy of it is built-in too
    is_built_in = built_in.is_file() and built_in.read_text().split()[:1] == [found]
    mark = "" if is_built_in else f"_{configuration_hash(asked)}"
    parameters = {"env": asked["env"], **asked["config"]}
    teacher = parameters.get("imitate", {}).get("teacher")
    kind = f"imitation of {teacher}" if teacher and not parameters["total_steps"] else algo
    return f"{algo}{mark}_seed{seed}", f"{kind} trained with seed {seed}", policy, parameters


def configuration_hash(asked: dict[str, Any]) -> str:
    """Return six digits that identify the arguments of a training except its seed."""
    rest = {name: value for name, value in asked.items() if name != "seed"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()[:6]
