"""Trained agents that play as policies do, from the folder that `eitbench train` leaves."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from eitbench.envs.console import Console
from eitbench.envs.injection_core import InjectionCore, Rules, operator_type, scaled


class Agent:
    """A policy that does what a model of stable-baselines3 thinks best; subclasses have the model.

    Whatever filter is inside the environment, the agent is shown the one of reduced order with which it was trained,
    and so injects the same.
    """

    model: ClassVar[Any]
    masked: ClassVar[bool]

    @classmethod
    def suits(cls, rules: Rules) -> bool:
        """Whether the world shows and takes what the model was trained on."""
        zeros = {name: np.zeros(space.shape or ()) for name, space in InjectionCore(rules, "reduced").space().items()}
        return bool(cls.model.action_space == rules.action_space
                    and cls.model.observation_space.shape == scaled(rules, zeros).shape)

    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        self.rules, self.memory = rules, None
        self.console: Console | None = None

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        begins = self.console is None
        if self.console is None:
            kind = operator_type(self.rules.scenario, "reduced")
            assert kind is not None
            self.console = Console(kind, self.rules, observation["frame"][None])
        else:
            self.console.take_in(observation["voltages"][None], observation["currents"][None])
        observation = observation | {name: array[0] for name, array in self.console.shown().items()}
        masks = {}
        if self.masked:
            spent = self.rules.budget is not None and observation["left"][1] == 0.0
            masks["action_masks"] = np.arange(self.model.action_space.n) >= spent * (self.model.action_space.n - 1)
        action, self.memory = self.model.predict(scaled(self.rules, observation), state=self.memory,
                                                 episode_start=np.array([begins]), deterministic=True, **masks)
        return action if action.ndim else int(action)


def load_agent(path: Path, content: bytes) -> tuple[str, str, type[Agent], dict[str, Any]]:
    """Name, title, policy and parameters of the model.zip at ``path`` with this ``content``.

    A model is unpickled, so it is code: the folder must hold its ``sha256``, and a file that differs is not opened.

    Raises
    ------
    ValueError
        If ``config.json`` or ``sha256`` is missing beside it, or the file is not the one that was left there.
    """
    try:
        asked = json.loads((path.parent / "config.json").read_text())
        expected = (path.parent / "sha256").read_text().split()[0]
    except (OSError, ValueError, IndexError) as error:
        raise ValueError(f"policy {path} must lie beside the config.json and sha256 that `eitbench train` leaves: "
                         f"{error}") from None
    found = hashlib.sha256(content).hexdigest()
    if found != expected:
        raise ValueError(f"policy {path} must have the sha256 that lies beside it, {expected}; it has {found}")
    from eitbench.training import algorithm_of
    algo, seed = asked["algo"], asked["seed"]
    model = algorithm_of(algo).load(path, device="cpu")
    policy = type("Policy", (Agent,), {"model": model, "masked": algo.startswith("maskable")})
    return f"{algo}_seed{seed}", f"{algo} trained with seed {seed}", policy, {"env": asked["env"], **asked["config"]}
