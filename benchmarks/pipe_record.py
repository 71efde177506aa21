"""Measurement sequence for timing filters and smoothers: the pipe of `Pipe2D` on a mesh of any
resolution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from eitbench.estimation import (
    Filter,
    LinearisedForwardModel,
    LinearMeasurement,
    Motion,
    nodal_filter,
)
from eitbench.numerics.mesh import rectangle_mesh
from eitbench.physics.observation import ObservationModel
from eitbench.physics.transport import ConvectionDiffusion
from eitbench.worlds.catalogue import PIPE_2D
from eitbench.worlds.world import Discretisation

WARM_UP, STEPS = 60, 8
"""untimed steps; timed steps, half a frame"""


@dataclass
class Problem:
    """Linear Gaussian model with a measurement sequence."""

    start: Filter
    """filter at t = 0"""
    noise: np.ndarray
    """(n, n) Γ_w"""
    observations: list[LinearMeasurement]

    @property
    def n(self) -> int:
        return len(self.start.mean)

    @property
    def motion(self) -> Motion:
        return self.start.space.motion(1)


def problem(cells: tuple[int, int], steps: int = WARM_UP + STEPS) -> Problem:
    """Return the model on a mesh of ``cells``, and measurements simulated with it."""
    transport, seen = pipe_model(cells)
    level = PIPE_2D.expected_concentration
    evolution = transport.evolution_model()
    start = nodal_filter(transport, PIPE_2D.prior, level, rank_tolerance=1e-6)
    rng = np.random.default_rng(0)
    inflow = PIPE_2D.target.draw_inflow(PIPE_2D, rng)
    at_inlet = transport.mesh.points[transport.inlet]
    linearised = LinearisedForwardModel(seen, PIPE_2D.noise, start.mean)
    state = np.full(len(start.mean), PIPE_2D.background)
    observations = []
    currents = PIPE_2D.currents
    for t in range(steps):
        state = evolution.F @ state + evolution.Y @ inflow(at_inlet, t * PIPE_2D.time_step)
        H, _, variance, _ = linearised(np.zeros(16), currents[t % len(currents)])
        observations.append(LinearMeasurement(H, H @ state + np.sqrt(variance)
                                        * rng.standard_normal(len(H)), variance))
    noise = level**2 * evolution.state_noise_covariance(PIPE_2D.prior.inflow_std**2,
                                                        PIPE_2D.prior.nodal_std**2)
    return Problem(start, noise, observations)


def pipe_model(cells: tuple[int, int]) -> Discretisation:
    """Return the estimator model with ``cells`` of the concentration along and across the pipe."""
    told = PIPE_2D.estimator_model()
    pipe = PIPE_2D.vessel
    known = told.transport
    assert isinstance(known, ConvectionDiffusion)
    mesh = rectangle_mesh(np.linspace(0.0, pipe.length, cells[0] + 1),
                          np.linspace(-pipe.half_width, pipe.half_width, cells[1] + 1))
    transport = ConvectionDiffusion(mesh, PIPE_2D.flow.nominal(PIPE_2D, fine=False),
                                    PIPE_2D.flow.diffusivity, known.time_step,
                                    substeps=known.substeps, inlet=np.arange(cells[1] + 1))
    cem = told.observation.cem
    seen = ObservationModel(cem, mesh.interpolation_to(cem.mesh.points),
                            told.observation.conductivity, told.observation.min_concentration)
    return Discretisation(transport, seen)


def same(ours: np.ndarray, theirs: np.ndarray, tolerance: float = 1e-10) -> None:
    """Check that means agree relative to the largest entry."""
    np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=tolerance * np.abs(theirs).max())
