"""Proximal policy optimisation in one file, with torch and gymnasium only.

``python examples/ppo.py`` trains an agent for `eitbench/SearchAndTrack-v0`: a body comes and goes
in a tank, and the agent chooses the pair of electrodes of each injection. All episodes have the
same length, so a rollout is one episode in each of the parallel environments. The script prints the
mean returns of the agent and of random pairs on dev episodes; the page of the environment lists the
returns of other policies. The first rollouts simulate the training episodes, three seconds each,
once per machine.
"""

import argparse
from collections.abc import Callable

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Categorical

from eitbench.data.seeds import parse_seeds

GAMMA, LAMBDA = 0.9, 0.95
EPOCHS, MINIBATCHES = 5, 4
CLIP, ENTROPY, LEARNING_RATE, REWARD_SCALE = 0.2, 0.003, 1e-3, 200.0


def network(inputs: int, outputs: int, gain: float) -> nn.Sequential:
    """Return a network with two hidden layers; ``gain`` scales the last layer's initial weights."""
    last = nn.Linear(256, outputs)
    nn.init.orthogonal_(last.weight, gain)
    return nn.Sequential(nn.Linear(inputs, 256), nn.Tanh(), nn.Linear(256, 256), nn.Tanh(), last)


def roll_out(envs: gym.vector.VectorEnv, choose: Callable[[Tensor], Tensor],
             seeds: int | list[int] | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Return observations (T, B, d), actions (T, B) and rewards (T, B) of one episode each."""
    seen, actions, rewards = [], [], []
    observation, _ = envs.reset(seed=seeds)
    ended = np.array(False)
    while not ended.all():
        seen.append(torch.as_tensor(observation))
        actions.append(choose(seen[-1]))
        observation, reward, ended, _, _ = envs.step(actions[-1].numpy())
        rewards.append(torch.as_tensor(reward, dtype=torch.float32))
    return torch.stack(seen), torch.stack(actions), torch.stack(rewards)


def estimate_advantages(rewards: Tensor, values: Tensor) -> Tensor:
    """Return generalised advantage estimates (T, B); the value after the last step is zero."""
    result = torch.zeros_like(rewards)
    advantage = following = torch.zeros_like(values[0])
    for t in reversed(range(len(rewards))):
        advantage = rewards[t] + GAMMA * following - values[t] + GAMMA * LAMBDA * advantage
        result[t], following = advantage, values[t]
    return result


def train(envs: gym.vector.VectorEnv, steps: int, seed: int = 1) -> nn.Sequential:
    """Train for this number of steps of all environments; return the network of the logits."""
    torch.manual_seed(seed)
    inputs = envs.single_observation_space.shape[0]
    actor, critic = network(inputs, int(envs.single_action_space.n), 0.01), network(inputs, 1, 1.0)
    parameters = [*actor.parameters(), *critic.parameters()]
    optimiser = torch.optim.Adam(parameters, eps=1e-5)
    done = 0
    while done < steps:
        optimiser.param_groups[0]["lr"] = LEARNING_RATE * (1.0 - done / steps)
        with torch.no_grad():
            seen, actions, rewards = roll_out(
                envs, lambda observation: Categorical(logits=actor(observation)).sample(),
                None if done else seed)
            before = Categorical(logits=actor(seen)).log_prob(actions).flatten()
            values = critic(seen).squeeze(-1)
            advantages = estimate_advantages(REWARD_SCALE * rewards, values).flatten()
            targets = advantages + values.flatten()
        seen, actions = seen.flatten(0, 1), actions.flatten()
        for _ in range(EPOCHS):
            for part in torch.randperm(len(seen)).chunk(MINIBATCHES):
                policy = Categorical(logits=actor(seen[part]))
                ratio = (policy.log_prob(actions[part]) - before[part]).exp()
                advantage = advantages[part]
                advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
                clipped = torch.minimum(ratio * advantage,
                                        ratio.clamp(1.0 - CLIP, 1.0 + CLIP) * advantage)
                error = (critic(seen[part]).squeeze(-1) - targets[part]).square()
                loss = -clipped.mean() + 0.5 * error.mean() - ENTROPY * policy.entropy().mean()
                optimiser.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(parameters, 0.5)
                optimiser.step()
        printed = 20 * done // steps
        done += len(seen)
        if 20 * done // steps > printed:
            print(f"{done:9,} steps, training return {rewards.sum(0).mean():.3f}", flush=True)
    return actor


def mean_return(id: str, choose: Callable[[Tensor], Tensor], seeds: list[int]) -> float:
    """Return the mean return over these episodes."""
    with torch.no_grad():
        rewards = roll_out(gym.make_vec(id, num_envs=len(seeds)), choose, seeds)[2]
    return float(rewards.sum(0).mean())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="eitbench/SearchAndTrack-v0", help="environment id")
    parser.add_argument("--steps", type=int, default=1_000_000, help="steps of all environments")
    parser.add_argument("--episodes", type=int, default=256, help="number of training episodes")
    parser.add_argument("--dev", default="dev:0-31", help="episodes of the evaluation")
    given = parser.parse_args()
    space = gym.make(given.env).action_space
    if not isinstance(space, gym.spaces.Discrete):
        parser.error(f"--env must be an environment with Discrete actions, got {given.env} "
                     f"with {space}")
    torch.set_num_threads(1)
    agent = train(gym.make_vec(given.env, num_envs=64, episodes=given.episodes), given.steps)
    for name, choose in (("agent", lambda seen: agent(seen).argmax(-1)),
                         ("random pairs", lambda seen: torch.randint(int(space.n), (len(seen),)))):
        print(f"{name}: dev return {mean_return(given.env, choose, parse_seeds(given.dev)):.4f}")
