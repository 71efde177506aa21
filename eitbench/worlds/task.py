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
    """Estimate of one state: n nodes, L measurements of an injection, k flow parameters.

    Attributes
    ----------
    mean : (n,) array
        Concentration at the nodes of `Task.mesh`, mol/m³.
    variance : (n,) array, optional
        Error variance, (mol/m³)²; without it the calibration is not scored.
    innovation : (L,) array, optional
        Measured minus predicted voltages before the update, V; for the score NIS/m.
    innovation_covariance : (L, L) array, optional
        Covariance of the innovation, V².
    velocity : (k,) array, optional
        Parameters of the flow for `Task.velocity`, m/s; by default the prior mean.
    velocity_variance : (k,) array, optional
        Error variance of ``velocity``, m²/s².
    """

    mean: np.ndarray
    variance: np.ndarray | None = None
    innovation: np.ndarray | None = None
    innovation_covariance: np.ndarray | None = None
    velocity: np.ndarray | None = None
    velocity_variance: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Task:
    """Specification of an estimation problem; it does not contain the ground truth.

    Attributes
    ----------
    transport : Transport
        Evolution model on ``mesh``, with the nominal flow.
    observation : ObservationModel
        Voltages as a function of a concentration on ``mesh``.
    noise : VoltageNoise
        Its ``std(voltages)`` is the standard deviation of each measurement, V.
    currents : (K, L) array
        Injection cycle, A (A/m in 2D).
    n_steps : int
        Number of measurement vectors of an episode, t = 1 … n_steps.
    warm_up : int
        States t ≤ ``warm_up`` are not scored.
    lag : int
        Measurement t requests the state t − lag: 0 is filtering, n_steps − 1 smoothing.
    expected_concentration : float
        Rough expectation in mol/m³, at which the fit of the homogeneous estimate starts.
    calibration : int
        Number of first injections to which ĉ_bh is fitted; usually in the warm-up.
    prior : Prior
        Prior of the target relative to the best homogeneous estimate (thesis Table 5.1).
    velocity : VelocityModel, optional
        Parametrisation of the flow if it is estimated; ``transport`` has its prior mean.
    vessel : Vessel, optional
        Sizes and electrodes.
    world : str
        Name of the world, by which trained models are found.
    body : MovingBody, optional
        Conductivity, sizes, and parameters of the motion of a body that moves by itself.
    """

    transport: Transport
    observation: ObservationModel
    noise: VoltageNoise
    currents: np.ndarray = field(repr=False)
    n_steps: int
    warm_up: int
    lag: int
    expected_concentration: float
    calibration: int
    prior: Prior
    velocity: VelocityModel | None = None
    vessel: Vessel | None = None
    world: str = ""
    body: MovingBody | None = None

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
    """Return the task of a world.

    Parameters
    ----------
    world : World
    lag : int or "all"
        See `Task`; "all" requests all states after the last measurement.
    assumed
        Other assumptions on the flow than the default; see `World.estimator_model`.
    """
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
