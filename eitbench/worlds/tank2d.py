"""What the flat round tanks of the thesis' chapter 7 have in common: sixteen electrodes around saline."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from eitbench import _check
from eitbench.physics.observation import LinearConductivity, ObservationModel, VoltageNoise
from eitbench.worlds.base import Scenario

if TYPE_CHECKING:
    from eitbench.numerics.mesh import Mesh


@dataclass(frozen=True)
class Tank2D(Scenario):
    """A flat round tank: geometry, liquid, instrument; what moves is up to the scenario. All numbers are ours."""

    radius: float = 0.14
    """m"""
    n_electrodes: int = 16
    """around the wall; number 0 at angle 0, counted counter-clockwise"""
    electrode_cover: float = 0.5
    """part of the wall that electrodes cover, evenly spaced"""
    contact_impedance: float = 2e-3
    """z in Ω·m²"""
    current: float = 0.1
    """A/m; with relative noise the amplitude does not matter"""
    noise_relative: float = 0.01
    """std in parts of the reading, as in the thesis' pipe"""
    noise_of_largest: float = 0.001
    """std in parts of the largest voltage, as in the thesis' pipe"""
    background: float = 30.0
    """mol/m³, about 0.3 S/m: weak saline"""
    expected_concentration: float = 25.0
    """mol/m³; what estimators are told to expect, deliberately not the background"""
    molar_conductivity: float = 0.01
    """Λ in S·m²/mol; σ = Λc"""

    def __post_init__(self) -> None:
        for name, units in (("radius", "m"), ("contact_impedance", "Ω·m²"), ("current", "A/m"),
                            ("background", "mol/m³"), ("expected_concentration", "mol/m³"),
                            ("molar_conductivity", "S·m²/mol")):
            _check.number(name, getattr(self, name), low=0.0, open_low=True, units=units)
        _check.number("electrode_cover", self.electrode_cover, low=0.0, high=0.95, open_low=True)
        _check.integer("n_electrodes", self.n_electrodes, low=4)
        for name in ("noise_relative", "noise_of_largest"):
            _check.number(name, getattr(self, name), low=0.0)

    @property
    def noise(self) -> VoltageNoise:
        return VoltageNoise(self.noise_relative, self.noise_of_largest)

    @property
    def electrode_spans(self) -> np.ndarray:
        """(L, 2) first and last angle of each electrode in rad."""
        pitch = 2.0 * np.pi / self.n_electrodes
        return pitch * (np.arange(self.n_electrodes)[:, None] + 0.5 * self.electrode_cover * np.array([-1.0, 1.0]))

    def pair(self, source: int, sink: int) -> np.ndarray:
        """(L,) A/m: current enters at one electrode and leaves at another, numbers modulo L."""
        currents = np.zeros(self.n_electrodes)
        currents[source % self.n_electrodes] += self.current
        currents[sink % self.n_electrodes] -= self.current
        return currents

    def electrodes(self, mesh: Mesh) -> list[np.ndarray]:
        """Boundary facets of each electrode on an EIT mesh whose nodes include the electrodes' edges."""
        angle = np.arctan2(mesh.points[:, 1], mesh.points[:, 0])
        wall = np.hypot(*mesh.points.T) > (1.0 - 1e-9) * self.radius
        facets = []
        for first, last in self.electrode_spans:
            off_centre = np.abs(np.mod(angle - 0.5 * (first + last) + np.pi, 2.0 * np.pi) - np.pi)
            inside = wall & (off_centre < 0.5 * (last - first) + 1e-9)
            facets.append(mesh.facets_where(lambda points, inside=inside: inside))  # type: ignore[misc]
        return facets

    def disc(self, rings: int) -> Mesh:
        """The tank's bottom in evenly sized triangles, so many rings of them."""
        from eitbench.numerics.round import uniform_disc  # not needed to play recordings
        return uniform_disc(self.radius, rings)

    def observe(self, mesh: Mesh, cells_at_electrodes: int, rings: int) -> ObservationModel:
        """Voltages for concentrations on ``mesh``, with an EIT mesh of this fineness (see `electrode_disc`)."""
        from eitbench.numerics.round import electrode_disc
        from eitbench.physics.cem import CompleteElectrodeModel  # finite elements: not needed to play recordings
        eit_mesh = electrode_disc(self.radius, self.electrode_spans, cells_at_electrodes, rings)
        cem = CompleteElectrodeModel(eit_mesh, self.electrodes(eit_mesh), self.contact_impedance)
        return ObservationModel(cem, mesh.interpolation_to(eit_mesh.points),
                                LinearConductivity(self.molar_conductivity), 1e-2 * self.expected_concentration)


def disc_indicator(points: np.ndarray, centre: np.ndarray, radius: float, edge: float) -> np.ndarray:
    """1 inside a disc, 0 outside, going over within about ``edge`` (m); (k,) for points (k, 2)."""
    distance = np.hypot(*(points - centre).T)
    return 0.5 * (1.0 - np.tanh((distance - radius) / (0.5 * edge)))
