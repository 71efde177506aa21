"""Trained agents that play as policies do, from the folder that `eitbench train` leaves."""

from __future__ import annotations

import hashlib
import io
import json
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from eitbench.bench.methods import baseline_folder
from eitbench.envs.injection_core import InjectionCore, scaled
from eitbench.estimation.onboard.choice import operator_type
from eitbench.estimation.onboard.console import Console
from eitbench.estimation.onboard.rules import Rules


class Agent:
    """A policy that does what a model of stable-baselines3 thinks best; subclasses have the model.

    Whatever filter is inside the environment, the agent is shown the one of reduced order with
    which it was trained, and so injects the same.
    """

    model: ClassVar[Any]
    masked: ClassVar[bool]

    @classmethod
    def suits(cls, rules: Rules) -> bool:
        """Whether arrays have the shapes that the model was trained on, whatever they mean."""
        spaces = InjectionCore(rules, "reduced").space().items()
        seen = scaled(rules, {name: np.zeros(space.shape or ()) for name, space in spaces})
        return bool(cls.model.action_space == rules.action_space
                    and cls.model.observation_space.shape == seen.shape)

    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        self.rules = rules
        self.memory = None
        self.console: Console | None = None

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        begins = self.console is None
        if self.console is None:
            kind = operator_type(self.rules, "reduced")
            assert kind is not None
            self.console = Console(kind, self.rules, observation["frame"][None])
        else:
            self.console.take_in(observation["voltages"][None], observation["currents"][None])
        observation = observation | {name: array[0] for name, array in self.console.shown().items()}
        masks = {}
        if self.masked:
            spent = self.rules.budget is not None and observation["left"][1] == 0.0
            n = self.model.action_space.n
            masks["action_masks"] = np.arange(n) >= spent * (n - 1)
        action, self.memory = self.model.predict(
            scaled(self.rules, observation), state=self.memory, episode_start=np.array([begins]),
            deterministic=True, **masks)
        return action


def load_agent(path: Path, content: bytes) -> tuple[str, str, type[Agent], dict[str, Any]]:
    """Name, title, policy and parameters of the model.zip at ``path`` with this ``content``.

    The name is ALGO_seedK for our own agents, and bears a mark of the configuration,
    ALGO_MARK_seedK, for all others. A model is unpickled, so it is code: the folder must hold its
    ``sha256``, and a file that differs is not opened. ``ValueError`` if it differs, or if
    ``config.json`` or ``sha256`` is missing beside it.
    """
    try:
        asked = json.loads((path.parent / "config.json").read_text())
        expected = (path.parent / "sha256").read_text().split()[0]
    except (OSError, ValueError, IndexError) as error:
        raise ValueError(f"policy {path} must lie beside the config.json and sha256 that "
                         f"`eitbench train` leaves: {error}") from None
    found = hashlib.sha256(content).hexdigest()
    if found != expected:
        raise ValueError(f"policy {path} must have the sha256 that lies beside it, {expected}; "
                         f"it has {found}")
    from eitbench.rl.training import algorithm_of
    algo = asked["algo"]
    seed = asked["seed"]
    model = algorithm_of(algo).load(io.BytesIO(content), device="cpu")
    policy = type("Policy", (Agent,), {"model": model, "masked": algo.startswith("maskable")})
    mark = "" if _is_shipped(asked, found) else f"_{_mark(asked)}"
    parameters = {"env": asked["env"], **asked["config"]}
    return f"{algo}{mark}_seed{seed}", f"{algo} trained with seed {seed}", policy, parameters


def _is_shipped(asked: dict[str, Any], sha256: str) -> bool:
    """Whether it is one of our own agents, wherever its copy lies: a guest is given one."""
    ours = (baseline_folder() / "checkpoints" / asked["env"].replace("/", "-") / asked["algo"]
            / f"seed{asked['seed']}" / "sha256")
    return ours.is_file() and ours.read_text().split()[:1] == [sha256]


def _mark(asked: dict[str, Any]) -> str:
    """Six digits for what was asked of the training but its seed: configurations stay apart."""
    rest = {name: value for name, value in asked.items() if name != "seed"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()[:6]
