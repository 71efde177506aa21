"""The spec contains the length of an episode, without an effect on its end."""

import eitbench  # noqa: F401 (registers the ids)
import gymnasium as gym
import pytest

from short import short


@pytest.mark.parametrize("name", ["eitbench/Pipe2D-v0", "eitbench/Pipe2DSmoothing-v0", "eitbench/Pipe2DInjection-v0"])
def test_the_spec_contains_the_number_of_steps(name):
    """The last step of a variant is terminated and not truncated. Gymnasium's
    wrapper around an environment from such a spec changes only the flag truncated."""
    env = gym.make(name, **short(name))
    assert gym.spec(name).max_episode_steps is None
    steps = env.spec.max_episode_steps
    env.reset(seed=0)
    env.action_space.seed(0)
    ends = [env.step(env.action_space.sample())[2:4] for _ in range(steps)]
    assert ends == [(False, False)] * (steps - 1) + [(True, False)]
    again = gym.make(env.spec)
    again.reset(seed=0)
    assert [again.step(env.action_space.sample())[2:4] for _ in range(steps)][-1] == (True, True)
    many = gym.make_vec(env.spec, num_envs=2)
    assert many._length == steps
    with pytest.raises(ValueError, match=f"must be None or the steps of an episode, {steps}, got 1"):
        gym.make_vec(name, num_envs=2, max_episode_steps=1, **short(name))
