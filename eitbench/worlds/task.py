"""`Task`: the specification that an estimator receives; it does not contain the ground truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from eitbench import _check
from eitbench.physics.stationary import StationaryTransport
from eitbench.worlds.bodies import MovingBody
from eitbench.worlds.world import Discretisation, Prior, Vessel, World

if TYPE_CHECKING:
    from eitbench.numerics.mesh import Mesh
    from eitbench.physics.observation import ObservationModel, VoltageNoise
    from eitbench.physics.profiles import VelocityModel
    from eitbench.physics.transport import ConvectionDiffusion, EvolutionModel, Transport


class Estimate(NamedTuple):
    """Estimate of one state: n nodes, L measurements of an injection, k flow parameters."""

    mean: np.ndarray
    """(n,) mol/m³, concentration at the nodes of `Task.mesh`"""
    variance: np.ndarray | None = None
    """(n,) (mol/m³)², error variance; without it the calibration is not scored"""
    innovation: np.ndarray | None = None
    """(L,) V, measured minus predicted voltages before the update; for the score NIS/m"""
    innovation_covariance: np.ndarray | None = None
    """(L, L) V², covariance of the innovation"""
    velocity: np.ndarray | None = None
    """(k,) m/s, parameters of the flow for `Task.velocity`; by default the prior mean"""
    velocity_variance: np.ndarray | None = None
    """(k,) m²/s², error variance of ``velocity``"""


@dataclass(frozen=True, eq=False)
class Task:
    """Specification of an estimation problem; it does not contain the ground truth."""

    transport: Transport
    """evolution model on ``mesh``, with the nominal flow"""
    observation: ObservationModel
    """voltages as a function of a concentration on ``mesh``"""
    noise: VoltageNoise
    """its ``std(voltages)`` is the standard deviation of each measurement, V"""
    currents: np.ndarray = field(repr=False)
    """(K, L) injection cycle, A (A/m in 2D)"""
    n_steps: int
    """number of measurement vectors of an episode, t = 1 … n_steps"""
    warm_up: int
    """states t ≤ ``warm_up`` are not scored"""
    lag: int
    """measurement t requests the state t − lag: 0 is filtering, n_steps − 1 smoothing"""
    expected_concentration: float
    """rough expectation in mol/m³, at which the fit of the homogeneous estimate starts"""
    calibration: int
    """number of first injections to which ĉ_bh is fitted; usually in the warm-up"""
    prior: Prior
    """prior of the target relative to the best homogeneous estimate (thesis Table 5.1)"""
    velocity: VelocityModel | None = None
    """parametrisation of the flow if it is estimated; ``transport`` has its prior mean"""
    vessel: Vessel | None = None
    """sizes and electrodes"""
    world: str = ""
    """name of the world, by which trained models are found"""
    body: MovingBody | None = None
    """conductivity, sizes, and parameters of the motion of a body that moves by itself"""

    @property
    def mesh(self) -> Mesh:
        """Mesh of the estimates, the transport mesh."""
        return self.transport.mesh

    def transport_at(self, parameters: np.ndarray) -> ConvectionDiffusion:
        """Return the transport for flow parameters θ (k,) in m/s; ``ValueError`` if it has none."""
        from eitbench.physics.transport import ConvectionDiffusion
        if self.velocity is None or not isinstance(self.transport, ConvectionDiffusion):
            raise ValueError("the flow has no parameters in this task")
        return self.transport.with_velocity(self.velocity.field(parameters))

    @property
    def is_stationary(self) -> bool:
        """True if the target does not move."""
        return isinstance(self.transport, StationaryTransport) and self.body is None

    @property
    def evolution(self) -> EvolutionModel:
        """F, Y, H of the transport; computed on first use, shared by tasks with the same model."""
        return self.transport.evolution_model()


def make_task(world: World, lag: int | str = 0, **assumed: Any) -> Task:
    """Return the task of a world with a lag in steps; "all" requests all states after the last
    measurement. ``assumed`` are assumptions on the flow as of `World.estimator_model`."""
    if not isinstance(world, World):
        raise TypeError(f"world must be a World, as of gymnasium.make(id).unwrapped, got {world!r}")
    steps = lag_steps(world, lag)
    model = _model(world.truth_config, tuple(sorted(assumed.items())))
    currents = world.currents
    currents.setflags(write=False)  # shared by the users of this task
    return Task(model.transport, model.observation, world.instrument.model_noise, currents,
                world.n_steps, world.warm_up, steps, world.expected_concentration,
                world.calibration, world.prior, world.velocity_model, world.vessel, world.name,
                world.target if isinstance(world.target, MovingBody) else None)


def lag_steps(world: World, lag: int | str) -> int:
    """Return ``lag`` of `make_task` as a number; ``ValueError`` if it is out of range."""
    last = world.n_steps - 1
    if isinstance(lag, str) and lag != "all":
        raise ValueError(f"lag must be 'all' or an integer from 0 to {last}, got {lag!r}")
    return last if lag == "all" else _check.integer("lag", lag, low=0, high=last)


@lru_cache(maxsize=4)
def _model(config: World, assumed: tuple[tuple[str, Any], ...]) -> Discretisation:
    """Return the same object in each call: estimators cache derived matrices for it."""
    return config.estimator_model(**dict(assumed))
