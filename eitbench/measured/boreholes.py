"""Ground with electrodes in boreholes of one vertical plane (electrical resistivity tomography)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from eitbench import _check
from eitbench.numerics.mesh import Mesh, rectangle_mesh
from eitbench.numerics.round_meshes import extrude
from eitbench.physics.cem import CompleteElectrodeModel

SURFACE_CELLS, CELLS_ALONG, CELLS_ACROSS = 2, 1, 3
"""Cells of the electrode model above the first electrodes, between two electrodes of a borehole,
and between two boreholes."""
LAYERS = 7
"""Layers of the electrode model on one side of the plane."""
OUTER_CELLS = 5
"""Cells of the electrode model between the boreholes and the ends of the ground."""
EXTENT = 1.0
"""Distance of the ends of the ground from the electrodes, relative to the size of their grid."""
MARGIN_CELLS, MAX_CELLS = 4, 40
"""Cells of the mesh of estimates beyond the electrodes, and along a side of their grid at most."""


@dataclass(frozen=True)
class BoreholePlane:
    """A half-space with small electrodes at a grid of positions and depths in a vertical plane.

    The conductivity varies in the plane only, so that the potential is symmetric: the model is one
    half of the half-space, into which half of each current flows. An electrode is a square patch
    of the plane. They are numbered from top to bottom, one borehole after the other.
    """

    positions: tuple[float, ...]
    """m, horizontal, increasing"""
    depths: tuple[float, ...]
    """m below the surface, > 0, increasing"""
    electrode_size: float = 0.025
    """m, side of a patch"""

    is_elongated = False

    def __post_init__(self) -> None:
        _check.number("electrode_size", self.electrode_size, low=0.0, open_low=True, units="m")
        for name, low in (("positions", -np.inf), ("depths", 0.5 * self.electrode_size)):
            line = np.array(getattr(self, name), dtype=float)
            if (line.ndim != 1 or len(line) < 2 or not np.isfinite(line).all()
                    or line[0] <= low or np.diff(line).min() <= self.electrode_size):
                raise ValueError(f"{name} must be two or more numbers of m that increase by more "
                                 f"than the electrode_size of {self.electrode_size:g} m, and "
                                 f"depths below the surface, got {getattr(self, name)!r}")

    @property
    def n_electrodes(self) -> int:
        """Number of electrodes."""
        return len(self.positions) * len(self.depths)

    def transport_mesh(self, fine: bool) -> tuple[Mesh, np.ndarray]:
        """Return the mesh of estimates in the plane, in (position, −depth), and no inlet."""
        sides = np.ptp(self.positions), self.depths[-1]
        spacing = min(np.diff(self.positions).min(), np.diff(self.depths).min())
        cell = max(max(sides) / MAX_CELLS, 0.5 * spacing)
        x = np.arange(round(sides[0] / cell) + 1 + 2 * MARGIN_CELLS) - MARGIN_CELLS
        y = np.arange(round(sides[1] / cell) + 1 + MARGIN_CELLS)
        return (rectangle_mesh(self.positions[0] + sides[0] * x / (x[-1] - MARGIN_CELLS),
                               -sides[1] * y[::-1] / (y[-1] - MARGIN_CELLS)),
                np.empty(0, dtype=int))

    def electrode_model(self, fine: bool) -> CompleteElectrodeModel:
        """Return the complete electrode model in 3D, of first order."""
        far = EXTENT * max(np.ptp(self.positions), self.depths[-1])
        steps = np.geomspace(2.0 * self.electrode_size, far, OUTER_CELLS)
        half = 0.5 * self.electrode_size
        x = np.concatenate([self.positions[0] - half - steps[::-1],
                            self._lines(self.positions, CELLS_ACROSS),
                            self.positions[-1] + half + steps])
        depth = np.concatenate([np.linspace(0.0, self.depths[0] - half, SURFACE_CELLS + 1)[:-1],
                                self._lines(self.depths, CELLS_ALONG),
                                self.depths[-1] + half + steps])
        layers = np.geomspace(self.electrode_size, far, LAYERS)
        mesh = extrude(rectangle_mesh(x, -depth[::-1]), np.concatenate([[0.0], layers]))
        reach = half * (1.0 + 1e-6)
        plane = mesh.points[:, 2] == 0.0
        near = [np.abs(mesh.points[:, 0] - each) < reach for each in self.positions]
        level = [np.abs(mesh.points[:, 1] + each) < reach for each in self.depths]
        electrodes = [mesh.facets_of(plane & column & row) for column in near for row in level]
        return CompleteElectrodeModel(mesh, electrodes, 1e-4, order=1)

    def _lines(self, centres: Sequence[float], cells: int) -> np.ndarray:
        """Return coordinates of grid lines from the first to the last electrode."""
        half = 0.5 * self.electrode_size
        gaps = [np.linspace(a + half, b - half, cells + 1) for a, b in pairwise(centres)]
        return np.concatenate([[centres[0] - half], *gaps, [centres[-1] + half]])
