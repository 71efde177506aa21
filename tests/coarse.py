"""Worlds of ours on coarser meshes: the same physics and estimators at a fraction of the price."""

from dataclasses import dataclass, replace

import numpy as np
from eitbench.numerics.mesh import graded_pipe_mesh, rectangle_mesh
from eitbench.numerics.round import extrude, round_pipe_mesh, uniform_disc
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.worlds import entry, register
from eitbench.worlds.catalogue import PIPE_2D_BIASED, PIPE_2D_OBSTACLE, PIPE_3D
from eitbench.worlds.vessels import PlanePipe, RoundPipe


@dataclass(frozen=True)
class CoarsePlanePipe(PlanePipe):
    """The plane pipe with half the nodes; truth and model differ as much as ever."""

    lines = 20

    def carrier(self, fine):
        """3,751 nodes for the truth, 915 for the model."""
        along, across = (120, 30) if fine else (60, 14)
        R = self.half_width
        mesh = rectangle_mesh(np.linspace(0.0, self.length, along + 1),
                              np.linspace(-R, R, across + 1))
        return self.shaped(mesh), np.arange(across + 1)

    def electrode_model(self, fine):
        """As in `PlanePipe`, with fewer cells at each electrode and across."""
        at_electrodes, across = (7, 20) if fine else (4, 12)
        straight = graded_pipe_mesh(self.length, self.half_width, self.electrode_spans,
                                    at_electrodes, across)
        return CompleteElectrodeModel(self.shaped(straight), self.electrodes(straight),
                                      self.contact_impedance)


@dataclass(frozen=True)
class HalfRoundPipe(RoundPipe):
    """Half of the round pipe, with two of its four rings of electrodes."""

    length: float = 0.20
    electrode_rings: int = 2

    def carrier(self, fine):
        """3,175 nodes for the truth, 793 for the model."""
        rings, layers = (6, 24) if fine else (4, 12)
        section = uniform_disc(self.radius, rings)
        heights = np.linspace(0.0, self.length, layers + 1)
        return extrude(section, heights), np.arange(section.n_nodes)

    def electrode_model(self, fine):
        """10,608 unknowns for the truth, 4,086 for the model."""
        at_electrodes, rings = ((3, 4), 4) if fine else ((2, 3), 3)
        mesh = round_pipe_mesh(self.length, self.radius, self.spans_around, self.spans_along,
                               at_electrodes, rings, (2.5, 1.5, 2.5))
        return CompleteElectrodeModel(mesh, self.electrodes(mesh), self.contact_impedance,
                                      self.potential_order)


HALF_PIPE_3D = replace(
    PIPE_3D, vessel=HalfRoundPipe(),
    flow=replace(PIPE_3D.flow, mean_velocity=0.5 * PIPE_3D.flow.mean_velocity),
    schedule=replace(PIPE_3D.schedule, scored_steps=16))
"""At half the speed, so that as much of the pipe goes by within a frame; one frame is scored."""
COARSE = {
    "Pipe2DBiasedVelocity": replace(PIPE_2D_BIASED, vessel=CoarsePlanePipe()),
    "Pipe2DObstacle": replace(PIPE_2D_OBSTACLE,
                              vessel=CoarsePlanePipe(bulge=PIPE_2D_OBSTACLE.vessel.bulge)),
    "Pipe3D": HALF_PIPE_3D,
    "Pipe3DSmoothing": HALF_PIPE_3D,
}
"""By the name of the id they stand for."""


def register_coarse():
    """Register them, as coarse/….

    Returns
    -------
    list of str
        The ids.
    """
    for name, world in COARSE.items():
        ours = entry(f"eitbench/{name}-v0")
        register(world, f"coarse/{name}-v0", track=ours.track, **ours.settings)
    return [f"coarse/{name}-v0" for name in COARSE]
