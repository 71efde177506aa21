"""Evolution model of stationary tomography, c⁺ = c (thesis 7.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from eitbench.numerics.mesh import Mesh
    from eitbench.physics.transport import EvolutionModel


@dataclass(frozen=True, eq=False)
class StationaryTransport:
    """A `Transport` without advection, diffusion and inflow."""

    mesh: Mesh
    time_step: float
    """s between two injections"""

    @property
    def inlet(self) -> np.ndarray:
        """Empty array."""
        return np.empty(0, dtype=np.int64)

    def step(self, c: np.ndarray, inflow_before: np.ndarray | float = 0.0,
             inflow_after: np.ndarray | float = 0.0) -> np.ndarray:
        """Return a copy of the concentration."""
        return np.array(c, dtype=float)

    def evolution_model(self) -> EvolutionModel:
        """Return F = H = I and an empty Y."""
        # finite elements: cached episodes do not need them
        from eitbench.physics.transport import EvolutionModel
        identity = np.eye(self.mesh.n_nodes)
        return EvolutionModel(identity, np.zeros((self.mesh.n_nodes, 0)), identity)

    def transition(self) -> tuple[np.ndarray, np.ndarray]:
        """Return F and Y of `evolution_model`."""
        return self.evolution_model()[:2]
