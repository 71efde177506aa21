"""A vessel of any shape: two meshes from files, whose groups name the electrodes and the inlet."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from eitbench import _check
from eitbench.worlds.fields import check_positive

if TYPE_CHECKING:
    from eitbench.numerics.mesh import Mesh
    from eitbench.numerics.mesh_files import MeshFile
    from eitbench.physics.cem import CompleteElectrodeModel


@dataclass(frozen=True)
class MeshVessel:
    """A vessel whose meshes are drawn elsewhere, with gmsh say; see `eitbench.numerics.mesh_files`.

    Concentration and potential live on the same mesh. The truth has a finer one than the
    estimators' model: no inverse crime. Boundary facets of electrode l = 0 … L−1 form the group
    "electrode l", those through which the fluid enters the group "inlet", if there is one.
    """

    fine_file: str
    """path of the truth's mesh"""
    fine_sha256: str
    """of that file, in hexadecimal digits: another file is another world"""
    coarse_file: str
    """path of the model's mesh"""
    coarse_sha256: str
    """of that file"""
    n_electrodes: int
    """L"""
    scale: float = 1.0
    """m in a unit of the files; 1e-3 for mm"""
    contact_impedance: float = 2e-3
    """z in Ω·m²"""
    molar_conductivity: float = 0.01
    """Λ in S·m²/mol; σ = Λc"""
    patches: tuple[int, int] = (6, 6)
    """along x and y: the coarse grid on which an agent sees an estimate"""
    is_long: bool = False
    """whether pictures of it are laid one below the other"""

    parts_of_a_step = 2

    def __post_init__(self) -> None:
        check_positive(self, scale="m", contact_impedance="Ω·m²", molar_conductivity="S·m²/mol")
        _check.integer("n_electrodes", self.n_electrodes, low=2)
        for count in self.patches:
            _check.integer("each entry of patches", count, low=1)

    def substeps(self, fine: bool) -> int:
        return 16 if fine else 8

    def carrier(self, fine: bool) -> tuple[Mesh, np.ndarray]:
        mesh, groups = self._read(fine)
        return mesh, np.unique(groups.get("inlet", np.empty(0, dtype=int)))

    def electrode_model(self, fine: bool) -> CompleteElectrodeModel:
        from eitbench.physics.cem import CompleteElectrodeModel  # not needed to play recordings
        mesh, groups = self._read(fine)
        names = [f"electrode {number}" for number in range(self.n_electrodes)]
        if missing := [name for name in names if name not in groups]:
            raise ValueError(f"{self._file(fine)[0]}: must have a group for each electrode, got "
                             f"none for {', '.join(missing)}; there are {', '.join(groups)}")
        electrodes = [groups[name] for name in names]
        return CompleteElectrodeModel(mesh, electrodes, self.contact_impedance)

    def _file(self, fine: bool) -> tuple[str, str]:
        if fine:
            return self.fine_file, self.fine_sha256
        return self.coarse_file, self.coarse_sha256

    def _read(self, fine: bool) -> MeshFile:
        return _read(*self._file(fine), self.scale)


@lru_cache(maxsize=4)
def _read(path: str, sha256: str, scale: float) -> MeshFile:
    from eitbench.numerics.mesh_files import read_mesh
    return read_mesh(path, sha256, scale=scale)
