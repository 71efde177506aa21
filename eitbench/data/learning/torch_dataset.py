"""Examples as tensors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch.utils.data import Dataset as OfTorch

if TYPE_CHECKING:
    from eitbench.data.learning.examples import Dataset
    from eitbench.data.learning.reduced import ReducedDataset


class TorchDataset(OfTorch[dict[str, torch.Tensor]]):
    """A dataset of torch whose items hold the fields of an `Example` in single precision.

    Episodes that were never simulated are, one by one, when they are asked for: `eitbench bank`
    does so sooner and faster.
    """

    def __init__(self, examples: Dataset | ReducedDataset) -> None:
        self.examples = examples

    def __len__(self) -> int:
        return len(self.examples)

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        fields = self.examples[index]._asdict()
        seed = torch.tensor(fields.pop("seed"))
        return {"seed": seed} | {name: torch.from_numpy(np.array(field, dtype=np.float32))
                                 for name, field in fields.items()}
