"""What an operator sees of the estimator: its innovations, its estimate on a coarse grid, doubts
about electrodes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from eitbench.estimation.onboard.operator import Operator
    from eitbench.estimation.onboard.rules import Rules

DOUBT = 0.2
"""Weight of the last injection in the running share of readings that were not believed."""


class Console:
    """An estimator of B episodes, and what is shown of it.

    Parameters
    ----------
    kind : type of Operator
    rules : Rules
    frames : (B, K, L)
        Voltages in V of the first frame.
    """

    def __init__(self, kind: type[Operator], rules: Rules, frames: np.ndarray) -> None:
        self.operator = kind(rules.world, frames, gate=rules.gate,
                             noise_floor=rules.instrument.noise_floor)
        B, _, L = frames.shape
        self._innovations = np.zeros((B, L))
        self._doubt = np.zeros((B, 2, L))

    def take_in(self, voltages: np.ndarray, currents: np.ndarray) -> None:
        """One time step on, with voltages (B, L) in V for currents (B, L) in A (A/m in 2D)."""
        self._innovations, believed = self.operator.assimilate(voltages, currents)
        # Of each electrode: how often lately its own reading was not believed, and the injections
        # that it drove.
        reading = self._doubt[:, 0]
        driving = self._doubt[:, 1]
        injected = currents.any(axis=1, keepdims=True)
        drives = currents != 0.0
        failed = ~believed.any(axis=1, keepdims=True)
        # A failed injection says nothing of the electrodes that only listened.
        reading += DOUBT * (injected & ~failed) * (~believed - reading)
        driving += DOUBT * drives * (failed - driving)

    def shown(self) -> dict[str, np.ndarray]:
        """Arrays (B, …): innovations, mean, std, doubt, and where the flow is estimated its
        velocity and that's std."""
        mean, std = self.operator.grid()
        seen = {"innovations": self._innovations.copy(), "mean": mean, "std": std,
                "doubt": self._doubt.copy()}
        if (flow := self.operator.flow()) is not None:
            seen |= {"velocity": flow[0], "velocity_std": flow[1]}
        return seen
