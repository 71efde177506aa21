"""Estimation environments on short worlds, and helpers for their tests."""

import gymnasium as gym
import numpy as np
from eitbench.worlds import entries

from short import short

ESTIMATION = [id for id, each in entries().items() if each.track == "estimation"]
PIPE, LAGGED, SMOOTHING = (f"eitbench/Pipe2D{lag}-v0" for lag in ("", "FixedLag", "Smoothing"))
BIASED, UNKNOWN, SKEWED = (f"eitbench/Pipe2D{kind}Velocity-v0" for kind in ("Biased", "Unknown", "Skewed"))
OBSTACLE, SOLID = "eitbench/Pipe2DObstacle-v0", "eitbench/Pipe3D-v0"
STIRRED, STILL = "eitbench/RotatingTank2D-v0", "eitbench/StationaryTank2D-v0"
KINDS = [PIPE, LAGGED, SMOOTHING, UNKNOWN, SKEWED, OBSTACLE, SOLID, STIRRED, STILL]
"""One id of each kind of lag, flow, vessel and target; the others differ in numbers only."""


def make(name: str, **kwargs) -> gym.Env:
    """Make the environment of an id on its short world, with two training episodes."""
    return gym.make(name, **short(name) | kwargs)


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
