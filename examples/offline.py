"""Conservative Q-learning (Kumar et al. 2020) in one file: an agent from stored episodes only.

The data are Minari sets of one environment whose action is an electrode pair:

    eitbench export --format minari --env eitbench/BubbleTracking-v0 --policy random_pair \
        --seeds train:0-191 --out eitbench/bubbles/random-pair-v0
    python examples/offline.py eitbench/bubbles/random-pair-v0

Data of one pair also inform the values of pairs with a common electrode. The script prints the
mean return of the data, and of the agent on other episodes; the page of the environment lists the
returns of other policies.
"""

import argparse

import gymnasium as gym
import minari
import numpy as np
import torch
from torch import Tensor, nn

from eitbench.data.seeds import parse_seeds

GAMMA, CONSERVATISM = 0.3, 0.01
BATCH, LEARNING_RATE, AVERAGING, REWARD_SCALE = 256, 3e-4, 0.005, 200.0
WIDTH, FEATURES = 256, 8


class Values(nn.Module):
    """Values of all actions: a sum over both electrodes of a pair, and a product of their features.

    Parameters
    ----------
    inputs : int
        Number of entries of an observation.
    pairs : (A, 2)
        Electrodes of each action.
    """

    def __init__(self, inputs: int, pairs: np.ndarray) -> None:
        super().__init__()
        self.pairs = torch.as_tensor(pairs)
        self.shape = int(pairs.max()) + 1, 1 + FEATURES
        self.layers = nn.Sequential(
            nn.Linear(inputs, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH), nn.ReLU(),
            nn.Linear(WIDTH, self.shape[0] * self.shape[1]))

    def forward(self, observations: Tensor) -> Tensor:
        """Return values (B, A) of observations (B, d)."""
        electrodes = self.layers(observations).reshape(-1, *self.shape)
        first, second = electrodes[:, self.pairs[:, 0]], electrodes[:, self.pairs[:, 1]]
        product = (first[..., 1:] * second[..., 1:]).sum(-1)
        return first[..., 0] + second[..., 0] + product


def load(names: list[str]) -> tuple[gym.Env, dict[str, Tensor], float]:
    """Return the environment, all transitions, and the mean return of the data sets."""
    sets = [minari.load_dataset(name) for name in names]
    episodes = [episode for each in sets for episode in each.iterate_episodes()]
    parts = {
        "seen": [each.observations[:-1] for each in episodes],
        "next": [each.observations[1:] for each in episodes],
        "action": [each.actions for each in episodes],
        "reward": [REWARD_SCALE * each.rewards.astype(np.float32) for each in episodes],
        "last": [each.terminations.astype(np.float32) for each in episodes]}
    transitions = {name: torch.as_tensor(np.concatenate(each)) for name, each in parts.items()}
    mean_return = float(np.mean([each.rewards.sum() for each in episodes]))
    return sets[0].recover_environment(), transitions, mean_return


def train(pairs: np.ndarray, data: dict[str, Tensor], updates: int, seed: int = 1) -> Values:
    """Return the network after this number of updates."""
    torch.manual_seed(seed)
    network, target = (Values(data["seen"].shape[1], pairs) for _ in range(2))
    target.load_state_dict(network.state_dict())
    optimiser = torch.optim.Adam(network.parameters(), LEARNING_RATE)
    for update in range(updates):
        chosen = torch.randint(len(data["action"]), (BATCH,))
        part = {name: each[chosen] for name, each in data.items()}
        values = network(part["seen"])
        taken = values.gather(1, part["action"][:, None]).squeeze(1)
        with torch.no_grad():
            best = network(part["next"]).argmax(1, keepdim=True)        # double Q-learning
            following = target(part["next"]).gather(1, best).squeeze(1)
            expected = part["reward"] + GAMMA * (1.0 - part["last"]) * following
        excess = (values.logsumexp(1) - taken).mean()
        loss = (taken - expected).square().mean() + CONSERVATISM * excess
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        with torch.no_grad():
            for slow, fast in zip(target.parameters(), network.parameters(), strict=True):
                slow.lerp_(fast, AVERAGING)
        if 10 * update // updates > 10 * (update - 1) // updates:
            print(f"{update:7,} updates, loss {loss.item():.3f}", flush=True)
    return network


def mean_return(env: gym.Env, network: Values, seeds: list[int]) -> float:
    """Return the agent's mean return over these episodes."""
    returns = []
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        returns.append(0.0)
        ended = False
        while not ended:
            with torch.no_grad():
                action = network(torch.as_tensor(observation)[None]).argmax().item()
            observation, reward, ended, _, _ = env.step(action)
            returns[-1] += reward
    return float(np.mean(returns))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", nargs="+", help="names of Minari data sets")
    parser.add_argument("--updates", type=int, default=5000)
    parser.add_argument("--dev", default="dev:32-63", help="episodes of the evaluation")
    given = parser.parse_args()
    torch.set_num_threads(1)
    env, transitions, of_data = load(given.data)
    agent = train(env.unwrapped.rules.pairs, transitions, given.updates)
    print(f"mean return of the data: {of_data:.4f}; of the agent in {given.dev}: "
          f"{mean_return(env, agent, parse_seeds(given.dev)):.4f}")
