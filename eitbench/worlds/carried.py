"""Concentration carried by a flow from the inlet: how the truth of every pipe is simulated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from eitbench.physics.transport import ConvectionDiffusion
    from eitbench.worlds.base import Scenario

Inflow = Callable[[np.ndarray, float], np.ndarray]
"""(points (k, d) in m, time in s) -> concentration (k,) in mol/m³"""


def carry(scenario: Scenario, transport_at: Callable[[int], ConvectionDiffusion], inflows: Sequence[Inflow],
          tick: Callable[[int], object]) -> np.ndarray:
    """Concentrations (B, T + 1, n) in mol/m³ that B inflows make in one flow, t = 0 … T.

    ``transport_at(t)`` moves the fluid from t − 1 to t, perhaps in several steps of its own; its mesh and inlet do
    not change. The vessel holds the background when the lead-in begins. ``tick`` as in `Scenario.evolve`.
    """
    first = transport_at(1 - scenario.lead_in)
    inlet = first.mesh.points[first.inlet]
    states = np.empty((len(inflows), scenario.n_steps + 1, first.mesh.n_nodes))
    c = np.full((first.mesh.n_nodes, len(inflows)), scenario.background)
    for t in range(-scenario.lead_in + 1, scenario.n_steps + 1):
        transport = transport_at(t)
        dt = transport.time_step
        for k in range(round(scenario.time_step / dt)):
            before = (t - 1) * scenario.time_step + k * dt
            c = transport.step(c, *(np.stack([inflow(inlet, time) for inflow in inflows], axis=1)
                                    for time in (before, before + dt)))
        if t >= 0:
            states[:, t] = c.T
        tick(len(inflows))
    return states
