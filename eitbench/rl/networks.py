"""Policy networks over electrode pairs with shared terms of the logits for each electrode.

The logit of a pair is the sum of a term of its source, a term of its sink, and a term of the pair.
A plain network would have to learn separately for all 15 pairs of an electrode that it is dead.
"""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
import torch
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule
from torch import nn


class PairLogits(nn.Module):
    """Logits of all pairs of L electrodes and of further actions from h features, initially small.

    Parameters
    ----------
    features, actions : int
        h, and the number of actions: L(L−1)/2 pairs and optionally one more, no injection.
    """

    incidence: torch.Tensor

    def __init__(self, features: int, actions: int) -> None:
        super().__init__()
        electrodes = int((1 + (1 + 8 * actions)**0.5) / 2)
        incidence = torch.zeros(actions, 2 * electrodes)
        for k, (i, j) in enumerate(combinations(range(electrodes), 2)):
            incidence[k, i] = incidence[k, electrodes + j] = 1.0
        self.register_buffer("incidence", incidence)
        self.worth = nn.Linear(features, 2 * electrodes)
        self.own = nn.Linear(features, actions)
        for layer in (self.worth, self.own):
            nn.init.orthogonal_(layer.weight, gain=0.01)
            nn.init.zeros_(layer.bias)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        logits: torch.Tensor = self.worth(features) @ self.incidence.T + self.own(features)
        return logits


class PairPolicy(ActorCriticPolicy):
    """Policy of PPO with `PairLogits`."""

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        _with_pairs(self, lr_schedule)


class MaskablePairPolicy(MaskableActorCriticPolicy):
    """Policy of PPO with action masks and `PairLogits`."""

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        _with_pairs(self, lr_schedule)


def _with_pairs(policy: Any, lr_schedule: Schedule) -> None:
    policy.action_net = PairLogits(policy.mlp_extractor.latent_dim_pi, int(policy.action_space.n))
    policy.optimizer = policy.optimizer_class(policy.parameters(), lr=lr_schedule(1),
                                              **policy.optimizer_kwargs)


def most_probable(policy: PairPolicy | MaskablePairPolicy, observation: np.ndarray,
                  action_masks: np.ndarray | None = None) -> int:
    """Return the deterministic action for an observation (d,) float32, in a third of the time of
    `predict`; ``action_masks`` (n,) bool marks the allowed actions."""
    with torch.no_grad():
        latent = policy.mlp_extractor.forward_actor(torch.as_tensor(observation)[None])
        logits = policy.action_net(latent)[0].numpy()
    return int(np.where(True if action_masks is None else action_masks, logits, -np.inf).argmax())
