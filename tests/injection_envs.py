"""Injection environments on short worlds, and helpers for their tests."""

import json

import gymnasium as gym
import numpy as np
from eitbench.bench import runner
from eitbench.bench.methods import load_method
from eitbench.bench.scores import Outcome
from eitbench.bench.tracks import Environment
from eitbench.worlds import entries

import short

NAME, INFLOW = "eitbench/Pipe2DInjection-v0", "eitbench/Pipe2DInjectionInflow-v0"
CURRENTS, FAULTS, BUDGET = (f"eitbench/Pipe2DInjection{kind}-v0" for kind in ("Currents", "Faults", "Budget"))
TANK, FLOW = "eitbench/RotatingTankInjection-v0", "eitbench/Pipe2DInjectionFlow-v0"
FEW_STEPS = short.merged(short.DRAWN, {"vessel": {"electrodes_per_wall": 8}})
"""Five steps, the agent's are the last three: the full filter of an unknown flow takes a second for each."""
INJECTION = [id for id, each in entries().items() if each.track == "injection"]


def make(estimator: str = "none", name: str = NAME, observation: str = "raw", longer: dict | None = None,
         **kwargs) -> gym.Env:
    """Make the environment of an id on its short world; ``longer`` overrides more parameters."""
    world = FEW_STEPS if name == FLOW and estimator == "full" else short.world(name)["world"]
    world = short.merged(world, longer or {})
    return gym.make(name, estimator=estimator, world=world, observation=observation, **kwargs)


def filter_of(whose):
    """Return the filters of an injection environment, or of a policy's belief."""
    return (whose.unwrapped.core if isinstance(whose, gym.Env) else whose).filters


def play(env: gym.Env, seed: int, actions: np.ndarray) -> list[tuple]:
    """Return (observation, reward, terminated, truncated, info) of each step of an episode of either track."""
    observation, info = env.reset(seed=seed)
    steps = [(observation, 0.0, False, False, info)]
    while not steps[-1][2]:
        action = actions[len(steps) - 1]
        steps.append(env.step(int(action) if action.ndim == 0 else action))
    return steps


def some_pairs(steps: int = 120, envs: int = 1, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(120, size=(steps, envs)).squeeze()


def some_actions(env: gym.Env, steps: int = 120) -> np.ndarray:
    if isinstance(env.action_space, gym.spaces.MultiDiscrete):
        return np.random.default_rng(0).integers(env.action_space.nvec, size=(steps, *env.action_space.shape))
    if env.action_space.shape:
        return np.random.default_rng(0).uniform(-1.0, 1.0, (steps, *env.action_space.shape)).astype(np.float32)
    return some_pairs(steps)


def arrays_of(observation) -> list[np.ndarray]:
    return [observation[key] for key in sorted(observation)] if isinstance(observation, dict) else [observation]


def injected(name: str, kwargs: dict, policy: str, seed: int, estimator: str = "full") -> Outcome:
    """Return the outcome of a policy's episode with this filter, for scores."""
    asked = Environment(name, json.dumps(kwargs | {"estimator": estimator}))
    return runner.run_method(asked, load_method(policy, "injection"), seed).outcome
