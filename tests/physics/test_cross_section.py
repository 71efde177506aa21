"""Flow of solute through the outlet of a pipe: analytic values, and balance with the inflow."""

import eitbench
import numpy as np
import pytest
from eitbench.numerics.round_meshes import extrude, uniform_disc
from eitbench.physics.cross_section import outlet_of
from eitbench.physics.flow import PlaneChannelFlow, RoundPipeFlow
from eitbench.physics.transport import ConvectionDiffusion
from eitbench.worlds import entry

R, V = 0.05, 4.5


@pytest.mark.parametrize(("name", "area"), [("Pipe2D", 2 * R), ("Pipe2DObstacle", 2 * R)])
def test_a_homogeneous_fluid_leaves_at_the_volumetric_flow(name, area):
    """∫ c v·n = c v̄ A."""
    transport = eitbench.make_task(entry(f"eitbench/{name}-v0").world).transport
    flow = outlet_of(transport).solute_flow(np.full(transport.mesh.n_nodes, 30.0), transport.velocity)
    assert flow == pytest.approx(30.0 * V * area, rel=1e-9)


def test_a_round_pipe():
    """∫ c v·n = c v̄ π R² up to the polygon of the mesh."""
    mesh = extrude(uniform_disc(R, 6), np.linspace(0.0, 0.1, 4))
    transport = ConvectionDiffusion(mesh, RoundPipeFlow(V, R), 5e-4, 5e-3)
    flow = outlet_of(transport).solute_flow(np.full(mesh.n_nodes, 30.0), transport.velocity)
    assert flow == pytest.approx(30.0 * V * np.pi * R**2, rel=0.05)


def test_a_profile_across_the_pipe():
    """For c = 2 + y/R and v = 1.5 v̄ (1 − η²)(1 + η), from a velocity other than the transport's, by hand."""
    transport = eitbench.make_task(entry("eitbench/Pipe2D-v0").world).transport
    y = transport.mesh.points[:, 1]
    laminar = PlaneChannelFlow(V, R)

    def skewed(points):
        return laminar(points) * (1.0 + points[:, 1:] / R)

    expected = 1.5 * V * R * (2 * 4 / 3 + 4 / 15)            # ∫(1 − η²)(1 + η)(2 + η) dη from −1 to 1
    assert outlet_of(transport).solute_flow(2.0 + y / R, skewed) == pytest.approx(expected, rel=1e-4)


def test_what_enters_leaves():
    """After the transit time the outlet has the flow of a constant inflow."""
    transport = eitbench.make_task(entry("eitbench/Pipe2D-v0").world).transport
    c = np.full(transport.mesh.n_nodes, 30.0)
    for _ in range(200):
        c = transport.step(c, 36.0, 36.0)
    outlet = outlet_of(transport)
    assert outlet.solute_flow(c, transport.velocity) == pytest.approx(36.0 * V * 2 * R, rel=2e-3)
