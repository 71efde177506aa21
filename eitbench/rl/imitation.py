"""Imitation learning from a teacher policy: DAgger (Ross, Gordon & Bagnell 2011).

The agent acts in training episodes, the teacher labels every observation with its action, and the
agent is fitted to all labels so far by cross-entropy, its critic to the returns of the episodes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from sb3_contrib import MaskablePPO
from tqdm import tqdm

from eitbench import _check
from eitbench.bench.methods import Method, load_method
from eitbench.envs.injection import InjectionEnv
from eitbench.envs.injection_core import flatten_scaled
from eitbench.estimation.onboard.rules import Rules

DEFAULTS = {"rounds": 4, "episodes": 50, "epochs": 10, "batch": 256, "learning_rate": 1e-3}


def imitate(model: Any, world: InjectionEnv, options: dict[str, Any], reward_scale: float,
            reference: np.ndarray | None, seed: int) -> None:
    """Fit ``model`` (PPO, with or without masks) to a policy.

    Parameters
    ----------
    world : InjectionEnv
        Environment with raw observations, whose training episodes are used.
    options : dict
        ``teacher`` (name or path of a policy), and optionally ``rounds``, ``episodes`` and
        ``epochs`` (per round), ``batch`` and ``learning_rate``. The teacher acts in the first
        round, the agent in the others.
    reference : (episodes, steps), optional
        Reward baseline that is subtracted, as in training.
    """
    settings = DEFAULTS | options
    teacher = load_method(str(options["teacher"]), "injection")
    random = np.random.default_rng([seed, 1])
    optimiser = torch.optim.Adam(model.policy.parameters(), lr=settings["learning_rate"])

    def act(observation: np.ndarray) -> Any:
        masks = {"action_masks": world.action_masks()} if isinstance(model, MaskablePPO) else {}
        action = model.predict(observation, **masks)[0]
        return action if action.ndim else int(action)

    labelled = []
    with tqdm(total=settings["rounds"] * settings["episodes"], unit="episode", disable=None,
              desc=f"imitating {teacher.name}") as bar:
        for turn in range(settings["rounds"]):
            for _ in range(settings["episodes"]):
                episode = int(random.integers(world.pool.max_episodes))
                stream = np.random.default_rng(int(random.integers(2**63)))
                seen, labels, rewards = rollout(world, teacher, episode, stream,
                                                act if turn else None)
                if reference is not None:
                    rewards -= reference[episode]
                returns = reward_scale * rewards
                for t in range(len(returns) - 2, -1, -1):
                    returns[t] += model.gamma * returns[t + 1]
                labelled.append((seen, labels, returns))
                bar.update()
            seen, labels, returns = map(np.concatenate, zip(*labelled, strict=True))
            _fit(model.policy, optimiser, seen, labels, returns, settings, random)


def load_compatible_policy(argument: str, name: str, rules: Rules) -> Method:
    """Load the policy of this name or path; ``ValueError`` if it is incompatible with the rules."""
    loaded = load_method(name, "injection")
    if not loaded.suits(rules):
        raise ValueError(
            f"{argument} must be a policy that suits env, got {name!r}, which does not")
    return loaded


def check_imitation(algo: str, options: dict[str, Any], rules: Rules) -> None:
    """Raise ``ValueError`` if an argument of `imitate` is invalid."""
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
    load_compatible_policy("imitate.teacher", str(options["teacher"]), rules)


def rollout(world: InjectionEnv, method: Method, episode: int, random: np.random.Generator,
            act: Callable[[np.ndarray], Any] | None = None) -> tuple[np.ndarray, ...]:
    """Run an episode with the actions of a policy or of ``act``; return scaled observations (T, d),
    the policy's actions (T, …), and rewards (T,)."""
    observation, _ = world.reset(seed=episode)
    policy = method.make(world.rules, random, *[world.core] * method.privileged)
    seen, actions, rewards = [], [], []
    for _ in range(world.episode_steps):
        actions.append(policy.act(observation))
        seen.append(flatten_scaled(world.rules, observation))
        observation, reward, *_ = world.step(actions[-1] if act is None else act(seen[-1]))
        rewards.append(reward)
    return np.array(seen), np.array(actions), np.array(rewards)


def _fit(policy: Any, optimiser: torch.optim.Optimizer, seen: np.ndarray, labels: np.ndarray,
         returns: np.ndarray, settings: dict[str, Any], random: np.random.Generator) -> None:
    """Fit a policy to scaled observations (N, d), actions (N,) and returns (N,)."""
    policy.set_training_mode(True)
    observations = torch.as_tensor(seen)
    actions = torch.as_tensor(labels)
    targets = torch.as_tensor(returns, dtype=torch.float32)
    scale = targets.std() + 1e-6
    parts = max(1, len(seen) // settings["batch"])
    for _ in range(settings["epochs"]):
        for part in np.array_split(random.permutation(len(seen)), parts):
            values, likelihood, _ = policy.evaluate_actions(observations[part], actions[part])
            residuals = (values.flatten() - targets[part]) / scale
            loss = -likelihood.mean() + 0.5 * (residuals**2).mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    policy.set_training_mode(False)
