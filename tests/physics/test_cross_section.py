"""Flow of solute through the outlet of a pipe: analytic values."""

import eitbench
import numpy as np
import pytest
from eitbench.numerics.round_meshes import extrude, uniform_disc
from eitbench.physics.cross_section import outlet_of
from eitbench.physics.flow import PlaneChannelFlow, RoundPipeFlow
from eitbench.physics.transport import ConvectionDiffusion
from eitbench.worlds import entry

R, V = 0.05, 4.5


def round_pipe():
    mesh = extrude(uniform_disc(R, 6), np.linspace(0.0, 0.1, 4))
    return ConvectionDiffusion(mesh, RoundPipeFlow(V, R), 5e-4, 5e-3)


@pytest.mark.parametrize(("name", "area", "tolerance"), [
    ("Pipe2DObstacle", 2 * R, 1e-9), ("round", np.pi * R**2, 0.05)])
def test_a_homogeneous_fluid_leaves_at_the_volumetric_flow(name, area, tolerance):
    """∫ c v·n = c v̄ A, in a round pipe up to the polygon of the mesh."""
    transport = (round_pipe() if name == "round" else
                 eitbench.make_task(entry(f"eitbench/{name}-v0").world).transport)
    c = np.full(transport.mesh.n_nodes, 30.0)
    flow = outlet_of(transport).flow_weights(transport.velocity) @ c
    assert flow == pytest.approx(30.0 * V * area, rel=tolerance)


def test_a_profile_across_the_pipe():
    """For c = 2 + y/R and v = 1.5 v̄ (1 − η²)(1 + η), from a velocity other than the transport's, by hand."""
    transport = eitbench.make_task(entry("eitbench/Pipe2D-v0").world).transport
    y = transport.mesh.points[:, 1]
    laminar = PlaneChannelFlow(V, R)

    def skewed(points):
        return laminar(points) * (1.0 + points[:, 1:] / R)

    expected = 1.5 * V * R * (2 * 4 / 3 + 4 / 15)            # ∫(1 − η²)(1 + η)(2 + η) dη from −1 to 1
    assert outlet_of(transport).flow_weights(skewed) @ (2.0 + y / R) == pytest.approx(expected, rel=1e-4)
