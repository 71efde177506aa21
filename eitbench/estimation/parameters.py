"""Parameters of the evolution model, all in terms of ĉ_bh (thesis Table 5.1)."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from eitbench.estimation.covariance import FreeCovariance
from eitbench.estimation.dense import DenseKalmanFilter, Transition
from eitbench.estimation.kalman import KalmanFilter
from eitbench.estimation.smoothness import smoothness_covariance
from eitbench.estimation.walk import RandomWalk
from eitbench.physics.rest import AtRest

if TYPE_CHECKING:
    from eitbench.numerics.mesh import Mesh
    from eitbench.physics.transport import Transport
    from eitbench.worlds.world import Prior


def starting_filter(transport: Transport, prior: Prior,
                    c_bh: float) -> KalmanFilter | ClosedVesselFilter:
    """A Kalman filter for the target's motion at t = 0, with the parameters of Table 5.1.

    Where the fluid flows through the vessel it is `table_5_1`'s. Where nothing flows in, the
    covariance without data has no limit, and the filter keeps its covariance as a full matrix.

    Parameters
    ----------
    transport
        The evolution model; `Task.transport`.
    prior : Prior
        `Task.prior`.
    c_bh : float
        Best homogeneous estimate in mol/m³.
    """
    if len(transport.inlet) and not isinstance(transport, AtRest):
        return table_5_1(transport, prior, c_bh)
    mean = np.full(transport.mesh.n_nodes, c_bh)
    initial = initial_covariance(transport.mesh, prior)
    noise: np.ndarray | None
    if isinstance(transport, RandomWalk):
        noise = (c_bh * prior.nodal_std)**2 * transport.covariance
        return ClosedVesselFilter(mean, c_bh**2 * initial, transport.step, noise)
    if isinstance(transport, AtRest):
        walk = (c_bh * prior.nodal_std)**2
        noise = walk * np.eye(len(mean)) if walk else None
        return ClosedVesselFilter(mean, c_bh**2 * initial, None, noise)
    noise = c_bh**2 * _state_noise(transport, prior)
    return ClosedVesselFilter(mean, c_bh**2 * initial, transport.evolution_model().F, noise)


RANK_TOLERANCE = 1e-4
"""See `KalmanFilter`: the estimates are those of the exact filter to 1e-7 of their standard
deviation, in a quarter of the time where n = 3,003 (``docs/pipe3d.md``)."""


def table_5_1(transport: Transport, prior: Prior, c_bh: float, *,
              rank_tolerance: float = RANK_TOLERANCE) -> KalmanFilter:
    """The Kalman filter of c⁺ = F c + Y c_in + w; arguments as in `starting_filter`.

    Inflow and initial state have mean ĉ_bh; Γ_η and Γ_e are diagonal, Γ_{0|0} is diagonal or
    smooth. As all of them scale with ĉ_bh², the covariance without data is computed once for a
    transport model and serves every episode.
    """
    F, Y, _ = transport.evolution_model()
    mean = np.full(len(F), c_bh)
    covariance = _free_covariance(transport, prior).scaled(c_bh**2)
    return KalmanFilter(F, Y.sum(axis=1) * c_bh, mean, covariance, rank_tolerance=rank_tolerance)


class ClosedVesselFilter(DenseKalmanFilter):
    """The Kalman filter of c⁺ = F c + w where nothing enters; at rest without F and Γ_w."""

    def __init__(self, mean: np.ndarray, covariance: np.ndarray, transition: Transition | None,
                 noise: np.ndarray | None) -> None:
        super().__init__(mean, covariance)
        self._transition = transition
        self._noise = noise
        self._initial = covariance
        self.forcing = np.zeros_like(self.mean)

    @property
    def transition(self) -> np.ndarray:
        """(n, n) F."""
        if self._transition is None:
            return np.eye(len(self.mean))
        if callable(self._transition):
            return self._transition(np.eye(len(self.mean)))
        return self._transition

    def predict(self) -> None:  # type: ignore[override]
        """Move one time step on."""
        super().predict(self._transition, None, self._noise)

    def apply_noise(self, X: np.ndarray) -> np.ndarray:
        """Γ_w X for X (n, k)."""
        return np.zeros_like(X) if self._noise is None else self._noise @ X

    def apply_initial(self, X: np.ndarray) -> np.ndarray:
        """Γ_{0|0} X for X (n, k)."""
        return self._initial @ X


def initial_covariance(mesh: Mesh, prior: Prior) -> np.ndarray:
    """Γ_{0|0} (n, n) for ĉ_bh = 1: diagonal, or smooth over `Prior.initial_length`; read-only."""
    if not prior.initial_length:
        return prior.initial_std**2 * np.eye(mesh.n_nodes)
    return _smooth(mesh, prior.initial_length, prior.initial_std)


@lru_cache(maxsize=4)
def _smooth(mesh: Mesh, length: float, std: float) -> np.ndarray:
    from eitbench.numerics.fem import mass_matrix, stiffness_matrix
    covariance = smoothness_covariance(mass_matrix(mesh), stiffness_matrix(mesh), length, std)
    covariance.setflags(write=False)
    return covariance


@lru_cache(maxsize=12)
def _free_covariance(transport: Transport, prior: Prior) -> FreeCovariance:
    return FreeCovariance(transport.evolution_model().F, _state_noise(transport, prior),
                          initial_covariance(transport.mesh, prior))


@lru_cache(maxsize=4)
def _state_noise(transport: Transport, prior: Prior) -> np.ndarray:
    """Γ_w (5.16) for ĉ_bh = 1."""
    model = transport.evolution_model()
    return model.state_noise_covariance(prior.inflow_std**2, prior.nodal_std**2)
