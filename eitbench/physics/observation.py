"""Observation model of EIT: σ(c), voltages, their derivatives by c, and their noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from eitbench import _check

if TYPE_CHECKING:
    import scipy.sparse as sp

    from eitbench.physics.cem import CompleteElectrodeModel


class ConductivityLaw(Protocol):
    """Elementwise σ(c) in S/m for c in mol/m³, and its derivative in S·m²/mol."""

    def __call__(self, concentration: np.ndarray) -> np.ndarray: ...

    def derivative(self, concentration: np.ndarray) -> np.ndarray: ...


@dataclass(frozen=True)
class LinearConductivity:
    """σ = Λ c, as in the thesis' pipe example (5.1.1)."""

    molar_conductivity: float
    """Λ in S·m²/mol, > 0; sodium chloride around 30 mol/m³: about 0.011"""

    def __post_init__(self) -> None:
        _check.number("molar_conductivity", self.molar_conductivity, low=0.0, open_low=True,
                      units="S·m²/mol")

    def __call__(self, concentration: np.ndarray) -> np.ndarray:
        return self.molar_conductivity * concentration

    def derivative(self, concentration: np.ndarray) -> np.ndarray:
        return np.full(np.shape(concentration), self.molar_conductivity)


@dataclass(frozen=True)
class VoltageNoise:
    """Independent Gaussian noise of voltages (thesis 5.1.1).

    std² = (relative·voltage)² + (relative_to_max·largest voltage of the injection)² + floor².
    Without the noise floor the noise scales with the current.
    """

    relative: float = 0.01
    """std relative to the measurement, ≥ 0; 0.01 in the thesis"""
    relative_to_max: float = 0.001
    """std relative to the largest voltage of the injection, ≥ 0; 0.001 in the thesis"""
    floor: float = 0.0
    """V, std of the absolute noise, ≥ 0; absent in the thesis"""

    def __post_init__(self) -> None:
        for name in ("relative", "relative_to_max"):
            _check.number(name, getattr(self, name), low=0.0)
        _check.number("floor", self.floor, low=0.0, units="V")

    def std(self, voltages: np.ndarray) -> np.ndarray:
        """Return the standard deviation in V for noise-free ``voltages`` (..., L), NaN where those
        are."""
        largest = np.fmax.reduce(np.abs(voltages), axis=-1, keepdims=True)
        variance = (self.relative * voltages)**2 + (self.relative_to_max * largest)**2
        return np.sqrt(variance + self.floor**2)


class VoltageModel(Protocol):
    """Interface of voltage models for estimators."""

    def voltages(self, concentration: np.ndarray, currents: np.ndarray) -> np.ndarray:
        """Noise-free voltages (K, L) in V for currents (K, L) in A (A/m in 2D)."""

    def linearise(self, concentration: np.ndarray,
                  currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Voltages (K, L) and their derivatives by c, (K, L, n) in V·m³/mol."""


class ObservationModel:
    """Model of the voltages V = U(c) for a nodal concentration on the transport mesh.

    The concentration is interpolated linearly to the non-conforming EIT mesh and converted to a
    conductivity. Values below ``min_concentration`` are replaced by it, with the slope of the law
    there, so that σ is positive for any estimate.

    Parameters
    ----------
    cem : CompleteElectrodeModel
    interpolation : (n_eit, n_cd) sparse
        From transport nodes to EIT nodes, see `Mesh.interpolation_to`.
    conductivity : ConductivityLaw
    min_concentration : float
        In mol/m³, > 0.
    """

    def __init__(self, cem: CompleteElectrodeModel, interpolation: sp.csr_array,
                 conductivity: ConductivityLaw, min_concentration: float) -> None:
        self.cem = cem
        self.interpolation = interpolation
        self.conductivity = conductivity
        self.min_concentration = _check.number(
            "min_concentration", min_concentration, low=0.0, open_low=True,
            units="mol/m³")

    def with_contacts(self, contact_impedance: np.ndarray) -> ObservationModel:
        """Return this model with other contact impedances (L,) in Ω·m², > 0."""
        return ObservationModel(self.cem.with_contacts(contact_impedance), self.interpolation,
                                self.conductivity, self.min_concentration)

    def transfer_resistance(self, concentration: np.ndarray) -> np.ndarray:
        """Return 𝓡 (..., L, L) in Ω (Ω·m in 2D) for ``concentration`` (..., n_cd) in mol/m³."""
        return self.cem.transfer_resistance(self.conductivity(self._at_eit_nodes(concentration)))

    def voltages(self, concentration: np.ndarray, currents: np.ndarray) -> np.ndarray:
        """Noise-free voltages (K, L) in V for currents (K, L) in A (A/m in 2D)."""
        return self.cem.voltages(self.conductivity(self._at_eit_nodes(concentration)), currents)

    def resistance_derivatives(self, concentration: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return 𝓡 (L, L) in Ω (Ω·m in 2D) and d𝓡/dc (n_cd, L, L), per mol/m³.

        They linearise the voltages of any injection: V = 𝓡 I, dV/dc_j = (d𝓡/dc_j) I.
        """
        n_nodes = self.interpolation.shape[1]
        c = self._at_eit_nodes(_check.array("concentration", concentration, (n_nodes,)))
        resistance, table = self.cem.transfer_resistance_derivatives(self.conductivity(c))
        table *= self.conductivity.derivative(c)[:, None, None]
        by_node = self.interpolation.T @ table.reshape(len(c), -1)
        return resistance, by_node.reshape(-1, *resistance.shape)

    def linearise(self, concentration: np.ndarray,
                  currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return voltages (K, L) and dV/dc (K, L, n_cd) in V·m³/mol (thesis 5.2)."""
        c = self._at_eit_nodes(concentration)
        voltages, by_conductivity = self.cem.linearise(self.conductivity(c), currents)
        by_node = (by_conductivity * self.conductivity.derivative(c)).reshape(-1, len(c))
        return voltages, (by_node @ self.interpolation).reshape(*voltages.shape, -1)

    def homogeneous(self, level: float, currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return voltages (K, L) of the concentration ``level`` at all nodes, in mol/m³, and their
        derivatives (K, L) by ln c, in V."""
        c = self._at_eit_nodes(np.full(self.interpolation.shape[1], level))
        sigma = self.conductivity(c)
        resistance, by_scale = self.cem.scaled_resistance(sigma)
        by_log = level * self.conductivity.derivative(c)[0] / sigma[0]
        return currents @ resistance, by_log * (currents @ by_scale)

    def _at_eit_nodes(self, concentration: np.ndarray) -> np.ndarray:
        shape = (*np.shape(concentration)[:-1], self.interpolation.shape[1])
        c = _check.array("concentration", concentration, shape, units="mol/m³")
        nodal = (self.interpolation @ c.reshape(-1, c.shape[-1]).T).T.reshape(*c.shape[:-1], -1)
        return np.maximum(nodal, self.min_concentration)
