"""The electrode model and convection–diffusion in three dimensions, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from eitbench.numerics.fem import mass_matrix
from eitbench.numerics.mesh import Mesh
from eitbench.numerics.round_meshes import extrude
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.physics.flow import RoundPipeFlow
from eitbench.physics.transport import ConvectionDiffusion


def spherical_octant(radii: np.ndarray, n: int) -> Mesh:
    """Return the octant x, y, z ≥ 0 of the shell between first and last of ``radii``, n² triangles per sphere."""
    i, j = (index.ravel() for index in np.indices((n + 1, n + 1)))
    number = np.cumsum(i + j <= n).reshape(n + 1, n + 1) - 1
    up = [(number[p, q], number[p + 1, q], number[p, q + 1]) for p in range(n) for q in range(n - p)]
    down = [(number[p + 1, q + 1], number[p, q + 1], number[p + 1, q]) for p in range(n) for q in range(n - p - 1)]
    flat = Mesh(np.stack([i, j], axis=1)[i + j <= n] / n, np.array(up + down))
    body = extrude(flat, radii)
    x, y, r = body.points.T
    direction = np.tan(np.pi / 4 * np.stack([x, y, 1.0 - x - y], axis=1))             # towards the octant's corners
    return Mesh(r[:, None] * direction / np.linalg.norm(direction, axis=1, keepdims=True), body.cells)


@pytest.mark.parametrize(("order", "cells", "final"), [(1, (8, 16), 2e-3), (2, (5, 10), 7e-3)])
def test_spherical_shell(order, cells, final):
    """A radial current in an octant has the resistance 8·[(1/a − 1/b)/σ + z₁/a² + z₂/b²]/(4π).

    It converges like h²; the last error is 2.7e-4 with P1, where two errors almost cancel, 6.4e-3 with P2.
    """
    a, b, sigma, z = 0.03, 0.1, 0.4, np.array([2e-2, 5e-2])
    exact = 2 / np.pi * ((1 / a - 1 / b) / sigma + z[0] / a**2 + z[1] / b**2)
    errors = []
    for n in cells:
        mesh = spherical_octant(np.geomspace(a, b, n + 1), n)
        r = np.linalg.norm(mesh.points, axis=1)
        electrodes = [mesh.facets_where(lambda p, r=r, wall=wall: np.abs(r - wall) < 1e-9) for wall in (a, b)]
        (inner, outer), = CompleteElectrodeModel(mesh, electrodes, z, order).voltages(
            np.full(mesh.n_nodes, sigma), np.array([[1.0, -1.0]]))
        errors.append((inner - outer) / exact - 1)
    assert 1.8 < np.log2(errors[0] / errors[1]) < 2.2, errors
    assert abs(errors[1]) < final, errors


def test_shear_disperses_as_taylor_and_aris_say():
    """Long after a²/14.7D the section's mean slug spreads with D·[1 + (v̄a/D)²/48], here 3.1 D; measured 0.998 of it."""
    a, mean, D = 1.0, 1.0, 0.1
    # The slug is symmetric about the axis: a wedge will do, on whose flanks ∂c/∂n = 0.
    r = np.linspace(0.0, 1.0, 17)[1:]
    flank = np.stack([np.cos(0.1) * r, np.sin(0.1) * r], axis=1)
    k = np.arange(15)
    cells = np.concatenate([[[0, 1, 17]], np.stack([k + 1, k + 2, k + 18], axis=1),
                            np.stack([k + 1, k + 18, k + 17], axis=1)])
    section = Mesh(np.concatenate([np.zeros((1, 2)), flank, flank * [1, -1]]), cells)
    mesh = extrude(section, np.linspace(0.0, 24.0, 193))
    cd = ConvectionDiffusion(mesh, RoundPipeFlow(mean, a), D, 0.5, substeps=12)
    z, weights = mesh.points[:, 2], mass_matrix(mesh).sum(axis=0)
    c = np.exp(-0.5 * (z - 5.0)**2)
    start = weights @ c
    variance = []
    for _ in range(14):
        c = cd.step(c, 0.0, 0.0)
        share = weights * c / (weights @ c)
        variance.append(share @ (z - share @ z)**2)
    assert weights @ c == pytest.approx(start, rel=1e-5)                              # the slug is completely inside
    effective = (variance[-1] - variance[9]) / (2 * 4 * cd.time_step)
    assert effective == pytest.approx(D * (1 + 1 / 48 * (mean * a / D)**2), rel=0.01)
