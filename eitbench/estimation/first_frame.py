"""The first frame of an episode: where ĉ_bh, and with it all of Table 5.1, comes from."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from eitbench.estimation.homogeneous import best_homogeneous

if TYPE_CHECKING:
    from eitbench.worlds.task import Task


class FirstFrame:
    """Collects the first frame; after it an estimator knows ĉ_bh and starts from t = 0.

    The frame lies within the warm-up, so that no scored estimate waits for it.
    """

    def __init__(self, task: Task) -> None:
        self.task = task
        self.length = task.calibration
        self.measurements: list[tuple[np.ndarray, np.ndarray]] = []
        self.c_bh = task.expected_concentration
        """mol/m³; the task's rough level until the frame is complete, then ĉ_bh"""

    @property
    def complete(self) -> bool:
        """Whether the whole frame has been measured."""
        return len(self.measurements) >= self.length

    def add(self, voltages: np.ndarray, currents: np.ndarray) -> bool:
        """Take in one measurement and say whether the frame is complete now."""
        self.measurements.append((voltages, currents))
        if self.complete:
            task = self.task
            V, I = (np.array(part) for part in zip(*self.measurements, strict=True))
            self.c_bh = best_homogeneous(task.observation, task.noise, task.mesh.n_nodes, V, I,
                                         self.c_bh)
        return self.complete

    @property
    def mean(self) -> np.ndarray:
        """(n,) homogeneous concentration: what there is to say for as long as the frame lasts."""
        return np.full(self.task.mesh.n_nodes, self.c_bh)
