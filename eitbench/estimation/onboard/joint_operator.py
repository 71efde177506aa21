"""The estimator of reduced order inside an injection environment with an unknown mean velocity.

It is the joint extended Kalman filter of `baselines/joint_extended_kalman_filter.py`, but for two
things: voltages are linearised about the level of the first frame, and the velocity has narrower
bounds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from eitbench.estimation.covariance import LowRankCovariance, OpenLoopCovariance
from eitbench.estimation.filter import Filter
from eitbench.estimation.nodal import (
    RANK_TOLERANCE,
    Motion,
    NodalStates,
    initial_covariance,
)
from eitbench.estimation.onboard.operator import BOUNDS, one_velocity, spread
from eitbench.estimation.onboard.reduced_operator import (
    RANK,
    ReducedOperator,
    Shared,
    record_of_any,
    stored_model,
)
from eitbench.estimation.reduced import ReducedFilter, learnt_of, main_directions
from eitbench.estimation.reduced_joint import (
    JointModel,
    JointTables,
    ReducedJointFilter,
    joint_model,
    joint_step,
)
from eitbench.worlds.task import make_task

if TYPE_CHECKING:
    from eitbench.worlds.world import World

TABLE = 16
"""Velocities within the bounds, evenly spaced, for which the reduced model is computed."""
LEARNING = (0.6, 1.0, 1.4)
"""Velocities, in parts of the one believed at first, at which the basis is learnt."""


class JointReducedOperator(ReducedOperator):
    """Joint extended Kalman filters in reduced order, in single precision."""

    _filter: ReducedJointFilter

    @staticmethod
    def _share(world: World) -> Shared:
        return JointShared.of(world)

    @property
    def state(self) -> np.ndarray:
        return self._filter.mean[:, :-1]

    @property
    def state_covariance(self) -> np.ndarray:
        return self._filter.covariance[:, :-1, :-1]

    def steps(self, count: int,
              along: np.ndarray | None = None) -> list[tuple[np.ndarray, np.ndarray]]:
        shared = self._shared
        made = []
        assert isinstance(shared, JointShared)
        mean = self._filter.mean[:1].astype(float)
        for k in range(count):
            mean = mean if along is None else along[k:k + 1]
            transition, noise = joint_step(shared.tables, mean, shared.walk_std**2)
            made.append((transition[0], noise[0]))
            moved = (transition[:, :-1, :-1] @ mean[:, :-1, None])[..., 0]
            mean = np.concatenate([moved, mean[:, -1:]], axis=1)
        return made

    @property
    def weight(self) -> np.ndarray | None:
        return np.pad(self._shared.mass[1:, 1:], (0, 1))

    def truth(self, entries: np.ndarray) -> np.ndarray:
        flow = self._shared.flow  # type: ignore[attr-defined]
        square = flow.profiles[:, 0]**2 @ flow.weights
        return np.column_stack([super().truth(entries), entries["velocity_moment"][:, 0] / square])

    def flow(self) -> tuple[np.ndarray, np.ndarray] | None:
        variance = self._filter.covariance[:, -1, -1:].astype(float)
        return self._filter.mean[:, -1:].astype(float), spread(variance)


class JointShared(Shared):
    """What all episodes of a world with an unknown mean velocity share."""

    model: JointModel

    def __init__(self, world: World) -> None:
        super().__init__(world)
        self.flow = one_velocity(self.levels.task)
        self.walk_std = self.flow.walk_std[0]
        self.tables = JointTables(self.model)
        self._single = JointTables(self.model, np.float32)

    @staticmethod
    def _make(world: World) -> Any:
        return stored_model(world, "joint", JointModel, lambda: make_model(world))

    def start(self, episodes: int) -> ReducedFilter:
        (nominal,) = self.flow.nominal
        (std,) = self.flow.initial_std
        r = len(self.model.initial)
        mean = np.zeros((episodes, r + 1))
        covariance = np.zeros((episodes, r + 1, r + 1))
        mean[:, r] = nominal
        covariance[:, :r, :r] = self.model.initial
        covariance[:, r, r] = std**2
        return ReducedJointFilter(self._single, mean.astype(np.float32),
                                  covariance.astype(np.float32), self.walk_std,
                                  (BOUNDS[0] * nominal, BOUNDS[1] * nominal))


def make_model(world: World) -> JointModel:
    """The model in double precision; some 45 s."""
    from eitbench.numerics.fem import mass_matrix
    task = make_task(world)
    flow = one_velocity(task)
    prior = task.prior
    mass = mass_matrix(task.mesh).toarray()
    record = record_of_any(world, 45)
    initial = initial_covariance(task.mesh, prior)
    nodal = task.evolution.state_noise_covariance(0.0, prior.nodal_std**2)

    def step(part: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """F, Y and Γ_w at a velocity; of the noise the nodal part stays what it is at first, as in
        `VelocityStates`."""
        F, Y = task.transport_at(np.array([part * flow.nominal[0]])).transition()
        return F, Y, prior.inflow_std**2 * (Y @ Y.T) + nodal

    learnt = np.zeros_like(mass)
    for part in LEARNING:
        F, Y, noise = step(part)
        covariance = LowRankCovariance(OpenLoopCovariance(F, noise), RANK_TOLERANCE)
        states = NodalStates(np.ones(len(F)), covariance, Motion(F, Y.sum(axis=1)))
        learnt += learnt_of(Filter(states), record, 10)
    parts = np.linspace(*BOUNDS, TABLE)
    basis = main_directions(learnt, mass, min(RANK, len(mass)))
    return joint_model(basis, mass, initial, parts * flow.nominal[0],
                       (step(part)[::2] for part in parts))
