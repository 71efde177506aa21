"""Estimation environments on short worlds, and helpers for their tests."""

import gymnasium as gym
import numpy as np
from eitbench.worlds import entries, entry

from short import short

ESTIMATION = [id for id, each in entries().items() if each.track == "estimation"]
AT_HOME = [id for id in ESTIMATION if not entry(id).nominal]
"""Ids without shifted environments, which have the same classes and differ in parameters only."""
PIPE, BIASED = "eitbench/Pipe2D-v0", "eitbench/Pipe2DBiasedVelocity-v0"
VELOCITY = [id for id in ESTIMATION if entry(id).world.velocity_model is not None]
"""Ids whose task requests the flow too."""
UNKNOWN, SKEWED = "eitbench/Pipe2DUnknownVelocity-v0", "eitbench/Pipe2DSkewedVelocity-v0"


def make(name: str, **kwargs) -> gym.Env:
    """Make the environment of an id on its short world, with two training episodes."""
    return gym.make(name, **short(name) | kwargs)


def play(env: gym.Env, seed: int, actions: np.ndarray) -> list[tuple]:
    """Return (observation, reward, terminated, truncated, info) of each step of an episode under these actions."""
    observation, info = env.reset(seed=seed)
    steps = [(observation, 0.0, False, False, info)]
    for action in actions:
        steps.append(env.step(action))
        if steps[-1][2]:
            break
    return steps


def noise_actions(env: gym.Env, seed: int = 0) -> np.ndarray:
    """Return plausible but meaningless estimates, enough for any episode here."""
    rng = np.random.default_rng(seed)
    return 30.0 + rng.standard_normal((60, *env.action_space.shape))


def best_velocity(base: gym.Env) -> np.ndarray:
    """Return (T, k) parameters with the best fit to the true flow; (T, 0) if the task does not request it."""
    model = base.task.velocity
    if model is None:
        return np.empty((base.task.n_steps, 0))
    root = np.sqrt(model.weights)
    true = (root * base.true_velocity()).T
    return np.linalg.lstsq(root[:, None] * model.profiles, true, rcond=None)[0].T
