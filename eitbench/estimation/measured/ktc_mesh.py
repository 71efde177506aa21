"""The meshes of the Kuopio Tomography Challenge 2023 as vessels.

Räsänen et al., "Kuopio Tomography Challenge 2023 (KTC2023)": doi:10.5281/zenodo.8252370.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from eitbench import _check
from eitbench.data.measured.matlab import needed, variables
from eitbench.numerics.mesh import Mesh

if TYPE_CHECKING:
    from eitbench.physics.cem import CompleteElectrodeModel

FIRST_GUESS = 1e-4
"""Ω·m², of the contact impedances."""


@dataclass(frozen=True, eq=False)
class MeshTank:
    """Fluid at rest on one mesh, on which concentration and potential live alike."""

    mesh: Mesh
    electrodes: tuple[np.ndarray, ...]
    """L times (k, 2) node numbers of boundary facets"""

    @property
    def n_electrodes(self) -> int:
        """L"""
        return len(self.electrodes)

    def carrier(self, fine: bool) -> tuple[Mesh, np.ndarray]:
        """The mesh, whether fine or not; nothing flows in."""
        return self.mesh, np.empty(0, dtype=int)

    def electrode_model(self, fine: bool) -> CompleteElectrodeModel:
        """With potentials of second order, on the same mesh."""
        from eitbench.physics.cem import CompleteElectrodeModel
        return CompleteElectrodeModel(self.mesh, self.electrodes, FIRST_GUESS)


def read_ktc_mesh(path: Path, scale: float = 1.0) -> MeshTank:
    """Of ``Mesh_sparse.mat`` or ``Mesh_dense.mat``: nodes ``g`` (n, 2), triangles ``H`` (m, 3) and
    the facets of each electrode ``elfaces`` (L cells of (k, 2)), numbered from 0 or 1.

    ``scale`` is m in a unit of the nodes. What there is of second order is not needed: the
    potential has its own. ``ValueError`` naming the file and what is wrong with it.
    """
    scale = _check.number("scale", scale, low=0.0, open_low=True, units="m")
    points, triangles, faces = needed(variables(path), path, "g", "H", "elfaces")
    try:
        cells = triangles.astype(np.int64)
        first = int(cells.min())
        electrodes = tuple(np.asarray(each, dtype=np.int64) - first for each in faces.ravel())
        tank = MeshTank(Mesh(scale * points, cells - first), electrodes)
        tank.electrode_model(fine=True)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path} must hold a mesh of triangles with electrodes on its wall: "
                         f"{error}") from None
    return tank
