"""`Task`: all that an estimator may know about a world, and nothing of what happened in it."""

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
    """What an estimator says about one state."""

    mean: np.ndarray
    """(n,) concentration at the nodes of `Task.mesh`, mol/m³."""
    variance: np.ndarray | None = None
    """(n,) its error variance, (mol/m³)²; None: no claim, and calibration is not scored."""
    innovation: np.ndarray | None = None
    """(L,) measured minus predicted voltages, V, before this measurement was used; for NIS."""
    innovation_covariance: np.ndarray | None = None
    """(L, L) its covariance, V²."""
    velocity: np.ndarray | None = None
    """(k,) the flow's parameters in m/s if `Task.velocity` asks; None: as believed at first."""
    velocity_variance: np.ndarray | None = None
    """(k,) their error variance, m²/s²."""


@dataclass(frozen=True, eq=False)
class Task:
    """The estimator's side of a world."""

    transport: Transport
    """the evolution model, on `mesh`"""
    observation: ObservationModel
    """voltages for a concentration on `mesh`"""
    noise: VoltageNoise
    currents: np.ndarray = field(repr=False)
    """(K, L) the injection cycle in A (A/m in 2D)"""
    n_steps: int
    """measurements in an episode, t = 1 … n_steps"""
    warm_up: int
    """states t ≤ warm_up are not scored"""
    lag: int
    """at measurement t the state t − lag is asked for: 0 filters, n_steps − 1 smooths it all"""
    expected_concentration: float
    """rough level in mol/m³, where the search for the best homogeneous estimate begins"""
    calibration: int
    """first injections, which that estimate is found from; all but always within the warm-up"""
    prior: Prior
    """believed of the target, in parts of the best homogeneous estimate (thesis Table 5.1)"""
    velocity: VelocityModel | None = None
    """how to write the flow if it is asked for too; ``transport`` has the one believed at first"""
    vessel: Vessel | None = None
    """its sizes and electrodes"""
    world: str = ""
    """its name, by which what was learned in it is found"""

    @property
    def mesh(self) -> Mesh:
        """Where estimates live: the CD mesh."""
        return self.transport.mesh

    def transport_at(self, parameters: np.ndarray) -> ConvectionDiffusion:
        """The model with the flow's ``parameters`` θ (k,) in m/s; ``ValueError`` if it has none."""
        from eitbench.physics.transport import ConvectionDiffusion
        if self.velocity is None or not isinstance(self.transport, ConvectionDiffusion):
            raise ValueError("the flow has no parameters in this task")
        return self.transport.with_velocity(self.velocity.field(parameters))

    @property
    def evolution(self) -> EvolutionModel:
        """F, Y, H of the transport; made on first use, shared by all tasks with the same model."""
        return self.transport.evolution_model()


def make_task(world: World, lag: int | str = 0, **assumed: Any) -> Task:
    """The task of ``world``.

    Parameters
    ----------
    world : World
    lag : int or "all"
        See `Task`; "all" means the whole record.
    assumed
        Wrong assumptions on the flow, as ``mean_velocity``; see `World.estimator_model`.
    """
    steps = lag_steps(world, lag)
    model = _model(world.truth_config, tuple(sorted(assumed.items())))
    currents = world.currents
    currents.setflags(write=False)                                # shared by all who play this task
    return Task(model.transport, model.observation, world.instrument.model_noise, currents,
                world.n_steps, world.warm_up, steps, world.expected_concentration,
                world.calibration, world.prior, world.velocity_model, world.vessel, world.name)


def lag_steps(world: World, lag: int | str) -> int:
    """``lag`` of `make_task` as a number; `ValueError` if it does not fit the world."""
    last = world.n_steps - 1
    if isinstance(lag, str) and lag != "all":
        raise ValueError(f"lag must be 'all' or an integer from 0 to {last}, got {lag!r}")
    return last if lag == "all" else _check.integer("lag", lag, low=0, high=last)


@lru_cache(maxsize=4)
def _model(fluid: World, assumed: tuple[tuple[str, Any], ...]) -> Discretisation:
    """Built once a process; estimators keep what they derive from it with it."""
    return fluid.estimator_model(**dict(assumed))
