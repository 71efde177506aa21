"""Networks of the learned baselines in torch, trained by `studies/learn.py`."""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.linalg import block_diag

N_LINEAR_MAPS = 4
DROPOUT = 0.2
"""Dropout of the hidden state during training."""
DIRECTIONS = (("", ""), ("backward_", "_reverse"))
"""Prefix of the names of weights in a network file, and suffix in torch."""


class Correction(torch.nn.Module):
    """Network of `eitbench.estimation.corrected`, for batches of complete episodes.

    A ``core`` with the attribute ``width`` replaces the GRU; such a network cannot be stored.
    """

    def __init__(self, input_scale: torch.Tensor, output_scale: torch.Tensor, hidden: int,
                 bidirectional: bool = False, noise: float = 0.0,
                 core: torch.nn.Module | None = None) -> None:
        super().__init__()
        self.register_buffer("input_scale", input_scale)
        self.register_buffer("output_scale", output_scale)
        self.noise = noise
        d = len(input_scale)
        q = len(output_scale)
        width = core.width if core else 2 * hidden if bidirectional else hidden
        self.core = core
        if core is None:
            self.gru = torch.nn.GRU(d, hidden, batch_first=True, bidirectional=bidirectional)
        self.output = torch.nn.Linear(width, 2 * q)
        self.mixing = torch.nn.Linear(width, N_LINEAR_MAPS)
        self.maps = torch.nn.Linear(d, N_LINEAR_MAPS * q, bias=False)
        self.velocity = torch.nn.Linear(width, 1)
        torch.nn.init.zeros_(self.output.weight)

    def forward(self, inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return corrections and log variances (B, T, q) in units of ``output_scale``, and
        velocities (B, T)."""
        inputs = inputs / self.input_scale
        if self.training:
            inputs = inputs + self.noise * torch.randn_like(inputs)
        hidden = self.core(inputs) if self.core else self.gru(inputs)[0]
        hidden = torch.nn.functional.dropout(hidden, DROPOUT, self.training)
        correction, log_variance = self.output(hidden).chunk(2, dim=-1)
        maps = self.maps(inputs).unflatten(-1, (N_LINEAR_MAPS, -1))
        mixed = (self.mixing(hidden).unsqueeze(-1) * maps).sum(dim=-2)
        return correction + mixed, log_variance, self.velocity(hidden).squeeze(-1)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays of a network file of `eitbench.estimation` in half precision."""
        arrays = {
            "input_scale": self.input_scale,
            "output_scale": self.output_scale,
            "output_weight": self.output.weight,
            "output_bias": self.output.bias,
            "mixing_weight": self.mixing.weight,
            "mixing_bias": self.mixing.bias,
            "maps": self.maps.weight.unflatten(0, (N_LINEAR_MAPS, -1)),
        }
        for prefix, suffix in DIRECTIONS[:1 + self.gru.bidirectional]:
            for name, short in (("input", "ih"), ("hidden", "hh")):
                arrays[f"{prefix}{name}_weight"] = getattr(self.gru, f"weight_{short}_l0{suffix}")
                arrays[f"{prefix}{name}_bias"] = getattr(self.gru, f"bias_{short}_l0{suffix}")
        return {name: each.detach().numpy().astype(np.float16) for name, each in arrays.items()}


def average_networks(networks: list[Correction]) -> dict[str, np.ndarray]:
    """Combine networks into one that returns their mean correction and log variance (deep
    ensembles, Lakshminarayanan et al. 2017); their hidden units do not interact."""
    members = [network.arrays() for network in networks]
    N = len(members)
    if N == 1:
        return members[0]
    combined = {name: members[0][name] for name in ("input_scale", "output_scale")}
    combined["output_bias"] = np.mean([each["output_bias"] for each in members], axis=0)
    combined["mixing_bias"] = np.concatenate([each["mixing_bias"] for each in members])
    combined["mixing_weight"] = block_diagonal([each["mixing_weight"] for each in members])
    combined["maps"] = np.concatenate([each["maps"] for each in members]) / N
    combined["output_weight"] = np.concatenate([each["output_weight"] for each in members],
                                               axis=1) / N
    gates = ("input_weight", "input_bias", "hidden_weight", "hidden_bias")
    for name in (name for name in members[0] if name.endswith(gates)):
        thirds = zip(*(np.split(each[name], 3) for each in members), strict=True)
        join = block_diagonal if name.endswith("hidden_weight") else np.concatenate
        combined[name] = np.concatenate([join(third) for third in thirds])
    if networks[0].gru.bidirectional:
        # hidden states: forward units of all members, then backward units of all members
        order = np.arange(combined["output_weight"].shape[1]).reshape(N, 2, -1)
        order = order.swapaxes(0, 1).ravel()
        for name in ("output_weight", "mixing_weight"):
            combined[name] = combined[name][:, order]
    return {name: array.astype(np.float16) for name, array in combined.items()}


def block_diagonal(blocks: Sequence[np.ndarray]) -> np.ndarray:
    """Return a block-diagonal matrix in double precision."""
    return block_diag(*(block.astype(float) for block in blocks))
