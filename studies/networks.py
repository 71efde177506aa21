"""The networks of our learned baselines in torch, as `studies/learn.py` trains them."""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.linalg import block_diag

MAPS = 4
DROPPED = 0.2
"""of the memory, while it learns"""
WAYS = (("", ""), ("backward_", "_reverse"))
"""What names of weights begin with in a network's file, and end with in torch."""


class Correction(torch.nn.Module):
    """As `eitbench.estimation.corrected` plays it, for batches of whole episodes."""

    def __init__(self, input_scale: torch.Tensor, output_scale: torch.Tensor, hidden: int,
                 both_ways: bool = False, noise: float = 0.0) -> None:
        super().__init__()
        self.register_buffer("input_scale", input_scale)
        self.register_buffer("output_scale", output_scale)
        self.noise = noise
        d = len(input_scale)
        q = len(output_scale)
        width = 2 * hidden if both_ways else hidden
        self.gru = torch.nn.GRU(d, hidden, batch_first=True, bidirectional=both_ways)
        self.output = torch.nn.Linear(width, 2 * q)
        self.mixing = torch.nn.Linear(width, MAPS)
        self.maps = torch.nn.Linear(d, MAPS * q, bias=False)
        self.velocity = torch.nn.Linear(width, 1)
        torch.nn.init.zeros_(self.output.weight)

    def forward(self, inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Corrections and log variances (B, T, q) in units of ``output_scale``, and velocities
        (B, T)."""
        inputs = inputs / self.input_scale
        if self.training:
            inputs = inputs + self.noise * torch.randn_like(inputs)
        memory, _ = self.gru(inputs)
        memory = torch.nn.functional.dropout(memory, DROPPED, self.training)
        correction, log_variance = self.output(memory).chunk(2, dim=-1)
        maps = self.maps(inputs).unflatten(-1, (MAPS, -1))
        mixed = (self.mixing(memory).unsqueeze(-1) * maps).sum(dim=-2)
        return correction + mixed, log_variance, self.velocity(memory).squeeze(-1)

    def arrays(self) -> dict[str, np.ndarray]:
        """As `eitbench.estimation.remember` and `said` take them, in half precision."""
        found = {
            "input_scale": self.input_scale,
            "output_scale": self.output_scale,
            "output_weight": self.output.weight,
            "output_bias": self.output.bias,
            "mixing_weight": self.mixing.weight,
            "mixing_bias": self.mixing.bias,
            "maps": self.maps.weight.unflatten(0, (MAPS, -1)),
        }
        for way, end in WAYS[:1 + self.gru.bidirectional]:
            for name, short in (("input", "ih"), ("hidden", "hh")):
                found[f"{way}{name}_weight"] = getattr(self.gru, f"weight_{short}_l0{end}")
                found[f"{way}{name}_bias"] = getattr(self.gru, f"bias_{short}_l0{end}")
        return {name: each.detach().numpy().astype(np.float16) for name, each in found.items()}


def joined(networks: list[Correction]) -> dict[str, np.ndarray]:
    """One network whose correction and log variance are the means of those of several (deep
    ensembles: Lakshminarayanan et al. 2017). Their units keep to themselves."""
    each = [network.arrays() for network in networks]
    many = len(each)
    if many == 1:
        return each[0]
    whole = {name: each[0][name] for name in ("input_scale", "output_scale")}
    whole["output_bias"] = np.mean([one["output_bias"] for one in each], axis=0)
    whole["mixing_bias"] = np.concatenate([one["mixing_bias"] for one in each])
    whole["mixing_weight"] = beside([one["mixing_weight"] for one in each])
    whole["maps"] = np.concatenate([one["maps"] for one in each]) / many
    whole["output_weight"] = np.concatenate([one["output_weight"] for one in each], axis=1) / many
    gates = ("input_weight", "input_bias", "hidden_weight", "hidden_bias")
    for name in (name for name in each[0] if name.endswith(gates)):
        thirds = zip(*(np.split(one[name], 3) for one in each), strict=True)
        join = beside if name.endswith("hidden_weight") else np.concatenate
        whole[name] = np.concatenate([join(third) for third in thirds])
    if networks[0].gru.bidirectional:
        # the memory is that of all units forward, then that of all backward
        order = np.arange(whole["output_weight"].shape[1]).reshape(many, 2, -1)
        order = order.swapaxes(0, 1).ravel()
        for name in ("output_weight", "mixing_weight"):
            whole[name] = whole[name][:, order]
    return {name: one.astype(np.float16) for name, one in whole.items()}


def beside(blocks: Sequence[np.ndarray]) -> np.ndarray:
    """Block-diagonal."""
    return block_diag(*(block.astype(float) for block in blocks))
