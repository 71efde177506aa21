"""Flow of solute through the outlet of a pipe (``docs/methods.md``, 4)."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
import skfem

from eitbench.numerics.fem import element, to_skfem
from eitbench.physics.transport import ConvectionDiffusion, VelocityField

MIN_NORMAL_VELOCITY = 0.01
"""Normal velocity at the outlet relative to the largest one: fluid leaves through these facets."""


class Outlet(NamedTuple):
    """Quadrature over the boundary facets through which fluid leaves a mesh with n nodes."""

    points: np.ndarray
    """(q, d) m"""
    normals: np.ndarray
    """(q, d) outward normal times weight, m (m² in 3D)"""
    interpolation: sp.csr_array
    """(q, n) from nodal values to the points"""

    def flow_weights(self, velocity: VelocityField) -> np.ndarray:
        """Compute (n,) weights in m³/s (m²/s in 2D) of nodal values c in mol/m³ whose sum is
        ∫ c v·n over the outlet in mol/s (mol/(s·m) in 2D)."""
        volume = (velocity(self.points) * self.normals).sum(axis=1)
        return np.asarray(volume @ self.interpolation)


@lru_cache(maxsize=4)
def outlet_of(transport: ConvectionDiffusion) -> Outlet:
    """Return the outlet of a transport's mesh, for its velocity."""
    mesh, velocity = transport.mesh, transport.velocity
    basis = skfem.FacetBasis(to_skfem(mesh), element(mesh.dim, 1), intorder=4)
    points = np.asarray(basis.global_coordinates()).reshape(mesh.dim, -1).T
    normals = (np.asarray(basis.normals) * basis.dx).reshape(mesh.dim, -1).T
    speed = (velocity(points) * normals).sum(axis=1) / np.linalg.norm(normals, axis=1)
    leaves = speed > MIN_NORMAL_VELOCITY * speed.max()
    points = points[leaves]
    return Outlet(points, normals[leaves], mesh.interpolation_to(points))
