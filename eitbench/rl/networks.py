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
    readings : int
        Number of further logits, of the electrodes to measure.
    """

    incidence: torch.Tensor

    def __init__(self, features: int, actions: int, readings: int = 0) -> None:
        super().__init__()
        electrodes = int((1 + (1 + 8 * actions)**0.5) / 2)
        incidence = torch.zeros(actions + readings, 2 * electrodes)
        for k, (i, j) in enumerate(combinations(range(electrodes), 2)):
            incidence[k, i] = incidence[k, electrodes + j] = 1.0
        self.register_buffer("incidence", incidence)
        self.worth = nn.Linear(features, 2 * electrodes)
        self.own = nn.Linear(features, actions + readings)
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
    pairs, *readings = _sizes(policy)
    policy.action_net = PairLogits(policy.mlp_extractor.latent_dim_pi, pairs, sum(readings))
    policy.optimizer = policy.optimizer_class(policy.parameters(), lr=lr_schedule(1),
                                              **policy.optimizer_kwargs)


def most_probable(policy: PairPolicy | MaskablePairPolicy, observation: np.ndarray,
                  action_masks: np.ndarray | None = None) -> Any:
    """Return the deterministic action for an observation (d,) float32, in a third of the time of
    `predict`; ``action_masks`` (n,) bool marks the allowed values of all components."""
    with torch.no_grad():
        latent = policy.mlp_extractor.forward_actor(torch.as_tensor(observation)[None])
        logits = policy.action_net(latent)[0].numpy()
    allowed = np.where(True if action_masks is None else action_masks, logits, -np.inf)
    parts = np.split(allowed, np.cumsum(_sizes(policy))[:-1])
    best = np.array([part.argmax() for part in parts])
    return best if len(best) > 1 else int(best[0])


def _sizes(policy: Any) -> list[int]:
    """Return the number of values of each component of a policy's actions."""
    space = policy.action_space
    return [int(n) for n in getattr(space, "nvec", [getattr(space, "n", 0)])]
