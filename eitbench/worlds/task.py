"""`Task`: the specification that an estimator receives; it does not contain the ground truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from eitbench import _check
from eitbench.worlds.world import Discretisation, Prior, Vessel, World

if TYPE_CHECKING:
    from eitbench.numerics.mesh import Mesh
    from eitbench.physics.observation import ObservationModel, VoltageNoise
    from eitbench.physics.profiles import VelocityModel
    from eitbench.physics.transport import ConvectionDiffusion, EvolutionModel, Transport


class Estimate(NamedTuple):
    """Estimate of one state."""

    mean: np.ndarray
    """(n,) concentration at the nodes of `Task.mesh`, mol/m³."""
    variance: np.ndarray | None = None
    """(n,) error variance, (mol/m³)²; None: calibration is not scored."""
    innovation: np.ndarray | None = None
    """(L,) measured minus predicted voltages, V, before the update; for NIS."""
    innovation_covariance: np.ndarray | None = None
    """(L, L) covariance of the innovation, V²."""
    velocity: np.ndarray | None = None
    """(k,) parameters of the flow in m/s for `Task.velocity`; None: the prior mean."""
    velocity_variance: np.ndarray | None = None
    """(k,) error variance of ``velocity``, m²/s²."""


@dataclass(frozen=True, eq=False)
class Task:
    """Specification of an estimation problem."""

    transport: Transport
    """evolution model, on `mesh`"""
    observation: ObservationModel
    """model of the voltages for a concentration on `mesh`"""
    noise: VoltageNoise
    currents: np.ndarray = field(repr=False)
    """(K, L) injection cycle in A (A/m in 2D)"""
    n_steps: int
    """measurements in an episode, t = 1 … n_steps"""
    warm_up: int
    """states t ≤ warm_up are not scored"""
    lag: int
    """measurement t requests the state t − lag: 0 is filtering, n_steps − 1 is smoothing"""
    expected_concentration: float
    """rough expectation in mol/m³, at which the fit of the homogeneous estimate starts"""
    calibration: int
    """first injections, to which the homogeneous estimate is fitted; usually in the warm-up"""
    prior: Prior
    """prior of the target relative to the best homogeneous estimate (thesis Table 5.1)"""
    velocity: VelocityModel | None = None
    """parametrisation of the flow if it is requested; ``transport`` has the prior mean"""
    vessel: Vessel | None = None
    """sizes and electrodes"""
    world: str = ""
    """name of the world, by which trained models are found"""

    @property
    def mesh(self) -> Mesh:
        """Mesh of the estimates, the transport mesh."""
        return self.transport.mesh

    def transport_at(self, parameters: np.ndarray) -> ConvectionDiffusion:
        """Return the transport with flow parameters θ (k,) in m/s; ``ValueError`` without such."""
        from eitbench.physics.transport import ConvectionDiffusion
        if self.velocity is None or not isinstance(self.transport, ConvectionDiffusion):
            raise ValueError("the flow has no parameters in this task")
        return self.transport.with_velocity(self.velocity.field(parameters))

    @property
    def evolution(self) -> EvolutionModel:
        """F, Y, H of the transport; computed on first use, shared by tasks with the same model."""
        return self.transport.evolution_model()


def make_task(world: World, lag: int | str = 0, **assumed: Any) -> Task:
    """Return the task of a world.

    Parameters
    ----------
    world : World
    lag : int or "all"
        See `Task`; "all" requests all states after the last measurement.
    assumed
        Wrong assumptions on the flow, as ``mean_velocity``; see `World.estimator_model`.
    """
    steps = lag_steps(world, lag)
    model = _model(world.truth_config, tuple(sorted(assumed.items())))
    currents = world.currents
    currents.setflags(write=False)  # shared by the users of this task
    return Task(model.transport, model.observation, world.instrument.model_noise, currents,
                world.n_steps, world.warm_up, steps, world.expected_concentration,
                world.calibration, world.prior, world.velocity_model, world.vessel, world.name)


def lag_steps(world: World, lag: int | str) -> int:
    """Return ``lag`` of `make_task` as a number; ``ValueError`` if it is out of range."""
    last = world.n_steps - 1
    if isinstance(lag, str) and lag != "all":
        raise ValueError(f"lag must be 'all' or an integer from 0 to {last}, got {lag!r}")
    return last if lag == "all" else _check.integer("lag", lag, low=0, high=last)


@lru_cache(maxsize=4)
def _model(config: World, assumed: tuple[tuple[str, Any], ...]) -> Discretisation:
    """Return one model per process, by which estimators cache derived matrices."""
    return config.estimator_model(**dict(assumed))
