"""Calibration: conductivity, contact impedances and noise that a record of homogeneous fluid
tells."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import least_squares, nnls

from eitbench import _check
from eitbench.physics.observation import VoltageNoise

if TYPE_CHECKING:
    from eitbench.physics.cem import CompleteElectrodeModel

CORRECTIONS = ("offset", "gain")
"""It is taken off all readings, or each reading is amplified by it."""
CONTACT_LEVEL = 0.1
"""z σ before anything is read, in parts of an electrode's length, …"""
CONTACT_LEVEL_STD = 2.0
"""… and the standard deviation of its logarithm."""
CONTACT_SPREAD = 0.5
"""Standard deviation of ln z_l about the mean of all electrodes, before anything is read."""
ASSUMED_NOISE = VoltageNoise(relative=0.01, of_largest=0.001)
"""Weighs readings against each other in the fit."""
FEWEST = 8
"""Frames that tell the noise."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """What readings of homogeneous fluid tell of vessel and instrument."""

    conductivity: float
    """σ in S/m"""
    conductivity_std: float
    """of ln σ: relative"""
    contact_impedance: np.ndarray
    """(L,) z in Ω·m²"""
    contact_impedance_std: np.ndarray
    """(L,) of ln z: relative"""
    gain: float
    """by which readings exceed what volts they stand for; 1 unless the conductivity was told"""
    noise: VoltageNoise
    """of a reading"""
    repeats: int
    """records of homogeneous fluid that tell the noise by how they differ"""
    noise_is_told: bool
    """whether records or frames tell the noise by how they differ; else it holds all that the model
    does not explain"""
    measured: np.ndarray
    """(K, M) V, the mean of the repeats; NaN where nothing was read"""
    computed: np.ndarray
    """(K, M) V, of the model with these numbers"""
    correction: str = "offset"
    """one of `CORRECTIONS`: what becomes of what the model of homogeneous fluid is off"""

    @property
    def residual(self) -> np.ndarray:
        """(K, M) measured less computed, in standard deviations of the noise of one reading."""
        std: np.ndarray = self.noise.std(np.nan_to_num(self.measured))
        return (self.measured - self.computed) / std

    @property
    def offset(self) -> np.ndarray:
        """(K, M) in V, 0 where nothing was read: what the model of homogeneous fluid is off, which
        is the mean of its approximation error (Kaipio & Somersalo 2005)."""
        if self.correction == "gain":
            return np.zeros_like(self.measured)
        return np.nan_to_num(self.measured - self.computed)

    @property
    def factor(self) -> np.ndarray:
        """(K, M): by which each reading exceeds the model's, where channels are amplified
        differently; else 1."""
        if self.correction == "offset":
            return np.ones_like(self.measured)
        return np.nan_to_num(self.measured / self.computed, nan=1.0)


def calibrate(electrodes: CompleteElectrodeModel, currents: np.ndarray, matrix: np.ndarray,
              readings: np.ndarray, *, depth: float = 1.0, conductivity: float | None = None,
              correction: str = "offset", noise: VoltageNoise | None = None,
              tick: Callable[[], object] = lambda: None) -> Calibration:
    """Fit σ and z_l to homogeneous fluid by Gauss–Newton in their logarithms.

    Contact impedances are drawn to their common mean where the readings do not tell them, and
    readings far off count less. Since readings scale as gain/σ at a given σz, the gain can only be
    told from a ``conductivity`` that is known. ``ValueError`` naming the argument if shapes do not
    fit, nothing was read, or the readings are of the opposite sign.

    Parameters
    ----------
    electrodes : CompleteElectrodeModel
        Of the vessel, with a first guess of the contact impedances.
    currents, matrix : (K, L) and (M, L)
        Injections in A, and from potentials to readings.
    readings : (F, K, M)
        F records of all injections in V; NaN where nothing was read.
    depth : float
        See `ReadingModel`.
    conductivity : float, optional
        σ in S/m if it is known.
    correction : "offset" or "gain"
        What becomes of what the model is off; see `Calibration`.
    noise : VoltageNoise, optional
        Of a reading, if it is known. Default: what repeats tell, or what the model leaves.
    tick : callable
        Called whenever the model has been computed.
    """
    if correction not in CORRECTIONS:
        raise ValueError(f"correction must be one of {', '.join(CORRECTIONS)}, got {correction!r}")
    L = electrodes.n_electrodes
    currents = _check.array("currents", currents, (None, L), units="A")
    matrix = _check.array("matrix", matrix, (None, L))
    readings = np.asarray(readings, dtype=float)
    if readings.ndim != 3 or readings.shape[1:] != (len(currents), len(matrix)):
        raise ValueError("readings must have shape (F, K, M) with K = "
                         f"{len(currents)} and M = {len(matrix)}, got {readings.shape}")
    there = np.isfinite(readings)
    seen = there.any(axis=0)
    if not seen.any():
        raise ValueError("readings must hold numbers, got NaN only")
    count = np.maximum(there.sum(axis=0), 1)
    mean = np.where(there, readings, 0.0).sum(axis=0) / count
    if not mean.any():
        raise ValueError("readings must differ from each other, got 0 V everywhere")
    model = _Homogeneous(electrodes, currents / depth, matrix, tick)

    level = float(np.log(CONTACT_LEVEL * lengths(electrodes).mean()))
    expected = np.array([0.0, level, *[0.0] * L])
    start, _ = model(expected)
    weight = seen / ASSUMED_NOISE.std(np.where(seen, mean, 1.0))
    relative = float((weight**2 * start * mean).sum() / (weight**2 * start**2).sum())
    if relative <= 0:
        raise ValueError("readings must have the sign of the model's, got the opposite: turn the "
                         "sign of the currents or of the measurement matrix, or the order in which "
                         "readings count electrodes")
    expected[0] = np.log(relative)
    x = expected
    for _ in range(2):                                  # the second time weighed by what was left
        x, jacobian = _fitted(model, x, expected, mean, weight, seen)
        explained, _ = model(x)
        left = _noise(mean[None], mean, explained, seen, np.ones_like(count))
        weight = seen / left.std(mean)
    told_apart = noise is not None or count.max() > 1
    if noise is None:
        noise = _noise(readings, mean, explained, seen, count)
    told = float(np.exp(-x[0]))                                     # σ if the gain is 1
    gain = 1.0 if conductivity is None else conductivity / told
    sigma = told if conductivity is None else conductivity
    spread = np.linalg.inv(jacobian.T @ jacobian)
    of_contacts = np.hstack([np.ones((L, 2)), np.eye(L)])           # ln z = ln ρ + mean + δ
    contact_std = np.sqrt(np.einsum("lp,pq,lq->l", of_contacts, spread, of_contacts))
    return Calibration(sigma, float(np.sqrt(spread[0, 0])), np.exp(x[1] + x[2:]) / sigma,
                       contact_std, gain, noise, int(count.max()), told_apart,
                       np.where(seen, mean, np.nan), explained, correction)


class _Homogeneous:
    """Readings for σ = 1/ρ and contacts ζ = z σ, by x = (ln ρ, mean of ln ζ, deviations from it),
    (2 + L,)."""

    def __init__(self, electrodes: CompleteElectrodeModel, driven: np.ndarray, matrix: np.ndarray,
                 tick: Callable[[], object]) -> None:
        self.electrodes = electrodes
        self.driven = driven
        self.matrix = matrix
        self._tick = tick

    def __call__(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K, M) in V, and the slopes by x (2 + L, K, M)."""
        contacts = np.exp(x[1] + x[2:])
        model = self.electrodes.with_contacts(contacts)
        R, by_contact = model.contact_derivatives(np.ones(model.mesh.n_nodes))
        by_contact *= contacts[:, None, None]
        of_all = np.exp(x[0]) * np.concatenate([R[None], by_contact.sum(axis=0)[None], by_contact])
        slopes = self.driven @ of_all @ self.matrix.T
        self._tick()
        return slopes[0], slopes


def _fitted(model: _Homogeneous, start: np.ndarray, expected: np.ndarray, mean: np.ndarray,
            weight: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x that fits best, and the slopes (·, 2 + L) of what is in standard deviations there."""
    prior = np.diag([0.0, 1.0 / CONTACT_LEVEL_STD, *[1.0 / CONTACT_SPREAD] * (len(start) - 2)])

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.concatenate([(weight * (model(x)[0] - mean))[seen], prior @ (x - expected)])

    def slopes(x: np.ndarray) -> np.ndarray:
        return np.vstack([(weight * model(x)[1])[:, seen].T, prior])

    x = least_squares(residuals, start, slopes, loss="soft_l1", xtol=1e-8, ftol=1e-8).x
    return x, slopes(x)


def lengths(electrodes: CompleteElectrodeModel) -> np.ndarray:
    """(L,) size of each electrode's wall: m in 2D, the root of its area in 3D."""
    points = electrodes.mesh.points
    sizes = []
    for facets in electrodes.electrodes:
        corners = points[facets]
        edges = corners[:, 1:] - corners[:, :1]
        if edges.shape[1] == 1:
            sizes.append(np.linalg.norm(edges[:, 0], axis=1).sum())
        else:
            area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum()
            sizes.append(np.sqrt(area))
    return np.array(sizes)


def _noise(readings: np.ndarray, mean: np.ndarray, computed: np.ndarray, seen: np.ndarray,
           count: np.ndarray) -> VoltageNoise:
    """std² = (relative·V)² + floor², by how repeats differ, or by what the model leaves."""
    if count.max() > 1:
        off = np.where(np.isfinite(readings), readings - mean, 0.0)
        told = seen & (count > 1)
        variance = (off**2).sum(axis=0)[told] / (count[told] - 1)
    else:
        told = seen
        variance = (mean - computed)[told]**2
    size = np.abs(mean[told])
    return _of_sizes(variance, size)


def noise_of_frames(frames: np.ndarray) -> VoltageNoise | None:
    """What readings of successive frames (F, K, M) in V tell: third differences, in which the noise
    remains and what changes slowly does not; None if there are fewer than `FEWEST` frames."""
    if len(frames) < FEWEST:
        return None
    there = np.isfinite(frames).all(axis=0)
    values = frames[:, there]
    # of fast targets too: the median of squares, of which normal ones have 0.455
    variance = np.median(np.diff(values, n=3, axis=0)**2, axis=0) / 20 / 0.455
    return _of_sizes(variance, np.abs(values).mean(axis=0))


def _of_sizes(variance: np.ndarray, size: np.ndarray) -> VoltageNoise:
    """std² = (relative·V)² + floor² that is nearest to these variances of readings of these sizes,
    the large and the small alike: variances count in parts of what they are about."""
    about = variance.mean() * (0.1 + size**2 / np.mean(size**2))
    terms = np.stack([size**2, np.ones_like(size)], axis=1) / about[:, None]
    (relative, floor), _ = nnls(terms, variance / about)
    least = 1e-6 * size.max()
    return VoltageNoise(float(np.sqrt(relative)), 0.0, float(max(np.sqrt(floor), least)))
