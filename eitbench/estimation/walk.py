"""A target of which nobody knows how it moves: each state is the one before, and a little."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from eitbench.estimation.smoothness import smoothness_covariance

if TYPE_CHECKING:
    from eitbench.numerics.mesh import Mesh
    from eitbench.physics.transport import EvolutionModel


@dataclass(frozen=True, eq=False)
class RandomWalk:
    """A `Transport` with c⁺ = c + e, where e is smooth over ``length``: a Matérn field."""

    mesh: Mesh
    """where the concentration lives"""
    time_step: float
    """s between two readings"""
    length: float
    """ℓ in m, > 0, over which what changes is alike; see `smoothness_covariance`"""

    @property
    def inlet(self) -> np.ndarray:
        """No node."""
        return np.empty(0, dtype=np.int64)

    def step(self, c: np.ndarray, inflow_before: np.ndarray | float = 0.0,
             inflow_after: np.ndarray | float = 0.0) -> np.ndarray:
        """The same concentration; there is no inlet for an inflow to enter by."""
        return np.array(c, dtype=float)

    @cached_property
    def covariance(self) -> np.ndarray:
        """(n, n) of e, of mean variance 1."""
        # finite elements: not needed to read what was estimated
        from eitbench.numerics.fem import mass_matrix, stiffness_matrix
        return smoothness_covariance(mass_matrix(self.mesh), stiffness_matrix(self.mesh),
                                     self.length, 1.0)

    def evolution_model(self) -> EvolutionModel:
        """F = I without any inlet; H Hᵀ is `covariance`."""
        from eitbench.physics.transport import EvolutionModel
        F, Y = self.transition()
        return EvolutionModel(F, Y, np.linalg.cholesky(self.covariance))

    def transition(self) -> tuple[np.ndarray, np.ndarray]:
        """F and Y of `evolution_model`."""
        n = self.mesh.n_nodes
        return np.eye(n), np.zeros((n, 0))
