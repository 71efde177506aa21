"""What is believed of a flow that is not known: a few numbers, each a random walk."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from eitbench import _check

if TYPE_CHECKING:
    from eitbench.physics.transport import ConvectionDiffusion, VelocityField
    from eitbench.worlds.task import Task


@dataclass(frozen=True, eq=False)
class UnknownFlow:
    """v = Σ θ_k v_k, with θ a random walk that begins at N(θ_0, diag(std²)).

    ``ValueError`` naming what is of the wrong shape, or not positive for θ_0.
    """

    transport_at: Callable[[np.ndarray], ConvectionDiffusion]
    """θ (k,) -> the model with that velocity; all with one mesh and one inlet"""
    directions: Sequence[VelocityField]
    """the k fields v_k"""
    start: np.ndarray
    """(k,) θ_0"""
    start_std: np.ndarray
    """(k,)"""
    walk_std: np.ndarray
    """(k,) of the steps of the walk, one a time step; zero for a constant velocity"""
    profiles: np.ndarray
    """(p, k) axial velocity of each v_k at p points across the flow, off the walls"""

    def __post_init__(self) -> None:
        k = len(self.directions)
        for name in ("start", "start_std", "walk_std"):
            object.__setattr__(self, name, _check.array(name, getattr(self, name), (k,)))
        profiles = _check.array("profiles", self.profiles, (None, k))
        object.__setattr__(self, "profiles", profiles)
        if not (profiles @ self.start > 0).all():
            raise ValueError("profiles must give a positive velocity with start, "
                             f"got {(profiles @ self.start).min():g}")


def asked_flow(task: Task) -> UnknownFlow:
    """The flow that a task asks for, as believed there; ``ValueError`` if it asks for none."""
    flow = task.velocity
    if flow is None:
        raise ValueError("task must ask for the flow, got one that does not")
    return UnknownFlow(task.transport_at, flow.directions, np.array(flow.nominal),
                       np.array(flow.initial_std), np.array(flow.walk_std), flow.profiles)


def scaled_flow(task: Task, std: float, walk_std: float) -> UnknownFlow:
    """The flow that a task tells, times a factor that begins at 1 ± ``std`` and walks: what is
    believed where it is told but not trusted. ``ValueError`` if nothing flows."""
    from eitbench.physics.transport import ConvectionDiffusion
    transport = task.transport
    if not isinstance(transport, ConvectionDiffusion):
        raise ValueError(f"task must have a flow, got {type(transport).__name__}")
    nominal = transport.velocity

    def transport_at(factor: np.ndarray) -> ConvectionDiffusion:
        return transport.with_velocity(lambda points: factor[0] * nominal(points))

    return UnknownFlow(transport_at, [nominal], np.ones(1), np.array([std]), np.array([walk_std]),
                       np.ones((1, 1)))
