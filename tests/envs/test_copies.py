"""A copy made during an episode continues like the original and is independent of it: for planning and saving."""

import copy
import pickle
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from estimation_envs import LAGGED, PIPE, SKEWED

from injection_envs import FAULTS, FLOW, INFLOW, NAME
from short import DRAWN, short

KINDS = [(LAGGED, {}), (SKEWED, {}), (NAME, {"estimator": "full", "observation": "raw"}), (FAULTS, {}),
         (FLOW, {}), (FLOW, {"estimator": "full", "world": DRAWN}), (INFLOW, {}), (INFLOW, {"estimator": "full"})]
COPIES = {"deepcopy": copy.deepcopy, "pickle": lambda env: pickle.loads(pickle.dumps(env))}


def begun(name: str, given: dict, seed: int | None = 1):
    """Return an environment after a reset and one step, and actions for further steps."""
    env = gym.make(name, **short(name) | given)
    env.reset(seed=seed)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(24)]
    env.step(actions.pop())
    return env, actions


def to_the_end(env, actions):
    """Return all step results until the episode ends, and at the beginning of the next episode."""
    seen = []
    for action in actions:
        seen.append(env.step(action))
        if seen[-1][2]:
            break
    return [*seen, env.reset(), env.step(actions[0])]


def assert_equal(these, those):
    """Compare up to rounding: arrays of a copy may be aligned differently, which changes BLAS's summation order."""
    assert len(these) == len(those)
    for a, b in zip(these, those, strict=True):
        if isinstance(a, dict):
            assert a.keys() == b.keys()
            assert_equal(list(a.values()), list(b.values()))
        elif isinstance(a, tuple):
            assert_equal(a, b)
        elif np.asarray(a).dtype.kind == "f":
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)
        else:
            np.testing.assert_equal(a, b)


@pytest.mark.parametrize(("name", "given"), KINDS)
def test_a_copy_goes_on_as_the_original_would(name, given):
    """Step results are equal to the end and in the next episode, for each kind of copy and any order of the two."""
    env, actions = begun(name, given)
    others = [how(env) for how in COPIES.values()]
    first = to_the_end(others[0], actions)
    played = to_the_end(env, actions)
    assert played[-3][2] is True
    for other, seen in ((others[0], first), (others[1], to_the_end(others[1], actions))):
        assert_equal(seen, played)
        assert other.unwrapped is not env.unwrapped and other.spec == env.spec


@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize(("name", "given"), [(PIPE, {}), (NAME, {}), (INFLOW, {"threads": 2})])
def test_vector_environments(name, given, how):
    """Copies of vector environments are equal too, with or without threads, also beyond the episode's end."""
    envs = gym.make_vec(name, num_envs=3, vectorization_mode="vector_entry_point", **short(name) | given)
    envs.reset(seed=1)
    envs.action_space.seed(0)
    actions = [envs.action_space.sample() for _ in range(9)]
    envs.step(actions[0])
    other = COPIES[how](envs)
    assert_equal([other.step(action) for action in actions], [envs.step(action) for action in actions])
    for each in (envs, other):
        each.close()


def test_in_another_process(tmp_path):
    env, actions = begun(NAME, {})
    (tmp_path / "env").write_bytes(pickle.dumps((env, actions)))
    code = (f"import pathlib, pickle, sys\nimport eitbench\nhere = pathlib.Path({str(tmp_path)!r})\n"
            "env, actions = pickle.loads((here / 'env').read_bytes())\n"
            "(here / 'steps').write_bytes(pickle.dumps([env.step(action) for action in actions[:3]]))\n")
    subprocess.run([sys.executable, "-c", code], check=True)
    there = pickle.loads((tmp_path / "steps").read_bytes())
    for a, b in zip(there, [env.step(action) for action in actions[:3]], strict=True):
        np.testing.assert_allclose(a[1], b[1], rtol=1e-9)
        assert a[2:] == b[2:]


def test_a_copy_is_small():
    """Models are not copied: in a pipe of the thesis' size a copy contains the episode without meshes."""
    env = gym.make(PIPE)
    env.reset(seed=0)
    assert env.unwrapped.task.mesh.n_nodes > 1000
    assert len(pickle.dumps(env)) < 5e6
