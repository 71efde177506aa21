"""Estimation environments on short worlds, and what tests do with them."""

import gymnasium as gym
import numpy as np
from eitbench.worlds import entries, entry

from short import short

ESTIMATION = [id for id, each in entries().items() if each.track == "estimation"]
AT_HOME = [id for id in ESTIMATION if not entry(id).nominal]
"""Without shifts, which are of the same classes and differ in numbers only."""
PIPE, BIASED = "eitbench/Pipe2D-v0", "eitbench/Pipe2DBiasedVelocity-v0"
VELOCITY = [id for id in ESTIMATION if entry(id).world.velocity_model is not None]
"""Where the flow is asked for too."""
UNKNOWN, SKEWED = "eitbench/Pipe2DUnknownVelocity-v0", "eitbench/Pipe2DSkewedVelocity-v0"


def make(name: str, **kwargs) -> gym.Env:
    """The environment of an id on its short world, with two training episodes."""
    return gym.make(name, **short(name) | kwargs)


def play(env: gym.Env, seed: int, actions: np.ndarray) -> list[tuple]:
    """(observation, reward, terminated, truncated, info) of the whole episode under these actions."""
    observation, info = env.reset(seed=seed)
    steps = [(observation, 0.0, False, False, info)]
    for action in actions:
        steps.append(env.step(action))
        if steps[-1][2]:
            break
    return steps


def noise_actions(env: gym.Env, seed: int = 0) -> np.ndarray:
    """Plausible but meaningless estimates, enough for any episode here."""
    rng = np.random.default_rng(seed)
    return 30.0 + rng.standard_normal((60, *env.action_space.shape))


def best_velocity(base: gym.Env) -> np.ndarray:
    """(T, k) parameters that fit the true flow best; (T, 0) where it is not asked for."""
    model = base.task.velocity
    if model is None:
        return np.empty((base.task.n_steps, 0))
    root = np.sqrt(model.weights)
    true = (root * base.true_velocity()).T
    return np.linalg.lstsq(root[:, None] * model.profiles, true, rcond=None)[0].T
