"""Learn from a teacher before reinforcement: DAgger (Ross, Gordon & Bagnell 2011).

Episodes are played by the pupil, the teacher says at every step what it would have done, and the
pupil learns that by cross-entropy on all that was ever said. The critic learns the returns of the
pupil's own episodes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from sb3_contrib import MaskablePPO
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from tqdm import tqdm

from eitbench import _check
from eitbench.bench.methods import Method, load_method
from eitbench.envs.injection import InjectionEnv
from eitbench.envs.injection_core import scaled
from eitbench.estimation.onboard.rules import Rules

DEFAULTS = {"rounds": 4, "episodes": 50, "epochs": 10, "batch": 256, "learning_rate": 1e-3}


def imitate(model: OnPolicyAlgorithm, world: InjectionEnv, options: dict[str, Any],
            reward_scale: float, reference: np.ndarray | None, seed: int) -> None:
    """Let ``model`` (PPO, with or without masks) learn from a policy file.

    Parameters
    ----------
    world : InjectionEnv
        With raw observations; its training episodes are played.
    options : dict
        ``teacher`` (name of one of our policies, or a path), and perhaps ``rounds``, ``episodes``
        (a round), ``epochs`` (a round), ``batch`` and ``learning_rate``. In the first round the
        teacher acts, in the others the pupil.
    reference : (episodes, steps), optional
        Rewards are counted from these, as in training.
    """
    settings = DEFAULTS | options
    teacher = load_method(str(options["teacher"]), "injection")
    random = np.random.default_rng([seed, 1])
    optimiser = torch.optim.Adam(model.policy.parameters(), lr=settings["learning_rate"])
    played = []
    with tqdm(total=settings["rounds"] * settings["episodes"], unit="episode", disable=None,
              desc=f"learning from {teacher.name}") as bar:
        for turn in range(settings["rounds"]):
            for _ in range(settings["episodes"]):
                number = int(random.integers(world.pool.most))
                seen, said, rewards = _play(model, world, teacher, number, random,
                                            pupil_acts=turn > 0)
                if reference is not None:
                    rewards -= reference[number]
                played.append((seen, said, _returns(reward_scale * rewards, model.gamma)))
                bar.update()
            gathered = [np.concatenate(part) for part in zip(*played, strict=True)]
            _fit(model, optimiser, gathered, settings, random)


def suited(argument: str, name: str, rules: Rules) -> Method:
    """The policy of this name or path; ``ValueError`` if it cannot play in this world."""
    loaded = load_method(name, "injection")
    if not loaded.suits(rules):
        raise ValueError(
            f"{argument} must be a policy that suits env, got {name!r}, which does not")
    return loaded


def check_imitation(algo: str, options: dict[str, Any], rules: Rules) -> None:
    """``ValueError`` if `imitate` could not do what is asked for in this world."""
    if set(options) - {*DEFAULTS, "teacher"} or "teacher" not in options:
        raise ValueError(
            f"imitate must hold teacher and may hold {', '.join(DEFAULTS)}; got {options!r}")
    if algo not in ("ppo", "maskable_ppo"):
        raise ValueError(f"imitate is for ppo and maskable_ppo, got {algo}")
    if rules.limit is not None:
        raise ValueError("imitate is for actions that are numbers, and env takes currents")
    settings = DEFAULTS | options
    for name in ("rounds", "episodes", "epochs", "batch"):
        _check.integer(f"imitate.{name}", settings[name], low=1)
    _check.number("imitate.learning_rate", settings["learning_rate"], low=0.0, open_low=True)
    suited("imitate.teacher", str(options["teacher"]), rules)


def _play(model: OnPolicyAlgorithm, world: InjectionEnv, teacher: Any, number: int,
          random: np.random.Generator, *, pupil_acts: bool) -> tuple[np.ndarray, ...]:
    """Of an episode: (T, d) scaled observations, (T,) what the teacher says, (T,) rewards."""
    observation, _ = world.reset(seed=number)
    stream = np.random.default_rng(int(random.integers(2**63)))
    advisor = teacher.make(world.rules, stream, *[world.core] * teacher.privileged)
    seen = []
    said = []
    rewards = []
    ended = False
    while not ended:
        action = int(advisor.act(observation))
        seen.append(scaled(world.rules, observation))
        said.append(action)
        if pupil_acts:
            masks = {"action_masks": world.action_masks()} if isinstance(model, MaskablePPO) else {}
            action = int(model.predict(seen[-1], **masks)[0])  # type: ignore[arg-type]
        observation, reward, ended, _, _ = world.step(action)
        rewards.append(reward)
    return np.array(seen), np.array(said), np.array(rewards)


def _returns(rewards: np.ndarray, discount: float) -> np.ndarray:
    returns = np.array(rewards, dtype=float)
    for t in range(len(returns) - 2, -1, -1):
        returns[t] += discount * returns[t + 1]
    return returns


def _fit(model: OnPolicyAlgorithm, optimiser: torch.optim.Optimizer, gathered: list[np.ndarray],
         settings: dict[str, Any], random: np.random.Generator) -> None:
    """On (N, d) scaled observations, (N,) what was said to them, (N,) returns."""
    seen, said, worth = gathered
    policy: Any = model.policy
    policy.set_training_mode(True)
    observations = torch.as_tensor(seen)
    actions = torch.as_tensor(said)
    returns = torch.as_tensor(worth, dtype=torch.float32)
    scale = returns.std() + 1e-6
    parts = max(1, len(seen) // settings["batch"])
    for _ in range(settings["epochs"]):
        for part in np.array_split(random.permutation(len(seen)), parts):
            values, likelihood, _ = policy.evaluate_actions(observations[part], actions[part])
            off = (values.flatten() - returns[part]) / scale
            loss = -likelihood.mean() + 0.5 * (off**2).mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    policy.set_training_mode(False)
