"""Trained agents as policies, loaded from the folder that `eitbench train` writes."""

from __future__ import annotations

import hashlib
import io
import json
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from eitbench.bench.methods import baseline_folder
from eitbench.envs.injection_core import InjectionCore, flatten_scaled
from eitbench.estimation.onboard.onboard_filter import OnboardFilter
from eitbench.estimation.onboard.reduced_filters import ReducedFilters
from eitbench.estimation.onboard.rules import Rules


class Agent:
    """Policy with the deterministic actions of a stable-baselines3 model, which subclasses set.

    The agent's observations come from the reduced filter with which it was trained, so its
    injections do not depend on the filter of the environment.
    """

    model: ClassVar[Any]
    uses_action_masks: ClassVar[bool]

    @classmethod
    def suits(cls, rules: Rules) -> bool:
        """Return whether spaces have the same shapes as in training."""
        core = InjectionCore(rules, "reduced", "scaled")
        return bool(cls.model.action_space == core.action_space
                    and cls.model.observation_space.shape == core.observation_space.shape)

    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        self.rules = rules
        self.hidden_state = None
        self.onboard: OnboardFilter | None = None

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        begins = self.onboard is None
        if self.onboard is None:
            self.onboard = OnboardFilter(ReducedFilters, self.rules, observation["frame"][None])
        else:
            self.onboard.assimilate(observation["voltages"][None], observation["currents"][None])
        features = self.onboard.features()
        observation = observation | {name: array[0] for name, array in features.items()}
        masks = {}
        if self.uses_action_masks:
            spent = self.rules.budget is not None and observation["left"][1] == 0.0
            n = self.model.action_space.n
            masks["action_masks"] = np.arange(n) >= spent * (n - 1)
        action, self.hidden_state = self.model.predict(
            flatten_scaled(self.rules, observation), state=self.hidden_state,
            episode_start=np.array([begins]), deterministic=True, **masks)
        return action


def load_agent(path: Path, content: bytes) -> tuple[str, str, type[Agent], dict[str, Any]]:
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
                         f"`eitbench train` writes: {error}") from None
    found = hashlib.sha256(content).hexdigest()
    if found != expected:
        raise ValueError(f"policy {path} must have the sha256 of its folder, {expected}, got "
                         f"{found}")
    from eitbench.rl.training import ALGORITHMS
    algo, seed = asked["algo"], asked["seed"]
    model = ALGORITHMS[algo].load(io.BytesIO(content), device="cpu")
    policy = type("Policy", (Agent,), {"model": model,
                                       "uses_action_masks": algo.startswith("maskable")})
    built_in = (baseline_folder() / "checkpoints" / asked["env"].replace("/", "-") / algo
                / f"seed{seed}" / "sha256")             # a copy of it is built-in too
    is_built_in = built_in.is_file() and built_in.read_text().split()[:1] == [found]
    mark = "" if is_built_in else f"_{configuration_hash(asked)}"
    parameters = {"env": asked["env"], **asked["config"]}
    return f"{algo}{mark}_seed{seed}", f"{algo} trained with seed {seed}", policy, parameters


def configuration_hash(asked: dict[str, Any]) -> str:
    """Return six digits that identify the arguments of a training except its seed."""
    rest = {name: value for name, value in asked.items() if name != "seed"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()[:6]
