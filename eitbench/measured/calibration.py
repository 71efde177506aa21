"""Calibration on homogeneous fluid: conductivity, contact impedances, gain and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares, nnls

from eitbench import _check
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.physics.observation import VoltageNoise

CORRECTIONS = ("offset", "gain")
CONTACT_PRIOR_MEAN = 0.1
"""Prior of z σ relative to the electrode's length, …"""
CONTACT_PRIOR_LOG_STD = 2.0
"""… the standard deviation of its logarithm, …"""
CONTACT_BETWEEN_LOG_STD = 0.5
"""… and that of ln z_l relative to the mean of all electrodes."""
FIT_NOISE = VoltageNoise(relative=0.01, relative_to_max=0.001)
"""Weights of the readings in the first fit."""
MIN_NOISE_FRAMES = 8


@dataclass(frozen=True, eq=False)
class Calibration:
    """Parameters of vessel and instrument, fitted to readings of homogeneous fluid."""

    conductivity: float
    """σ in S/m"""
    conductivity_std: float
    """of ln σ"""
    contact_impedance: np.ndarray
    """(L,) z in Ω·m²"""
    contact_impedance_std: np.ndarray
    """(L,) of ln z"""
    gain: float
    """readings per volt; 1 unless the conductivity was given"""
    noise: VoltageNoise
    """of one reading"""
    noise_from_repeats: bool
    """whether the noise is the scatter of repeats or frames; else it includes the model error"""
    measured: np.ndarray
    """(K, M) V, mean of the frames; NaN where nothing was measured"""
    computed: np.ndarray
    """(K, M) V, the fitted model"""
    correction: str = "offset"
    """one of `CORRECTIONS`, for the misfit of the fitted model"""

    @property
    def offset(self) -> np.ndarray:
        """(K, M) V subtracted from readings, 0 where nothing was measured: the mean approximation
        error of the model (Kaipio & Somersalo 2005)."""
        if self.correction == "gain":
            return np.zeros_like(self.measured)
        return np.nan_to_num(self.measured - self.computed)

    @property
    def channel_gain(self) -> np.ndarray:
        """(K, M) factor of each reading relative to the model, else 1."""
        if self.correction == "offset":
            return np.ones_like(self.measured)
        return np.nan_to_num(self.measured / self.computed, nan=1.0)


def calibrate(electrodes: CompleteElectrodeModel, currents: np.ndarray, matrix: np.ndarray,
              readings: np.ndarray, *, depth: float = 1.0, conductivity: float | None = None,
              correction: str = "offset", noise: VoltageNoise | None = None) -> Calibration:
    """Fit σ and z_l to homogeneous fluid by Gauss–Newton in their logarithms.

    A prior draws contact impedances to their common mean, and outliers have less weight. Readings
    scale as gain/σ at a given σz, so the gain is fitted only if the ``conductivity`` is known.
    ``ValueError`` names an argument of the wrong shape, readings without numbers, and readings of
    the opposite sign.

    Parameters
    ----------
    electrodes : CompleteElectrodeModel
        Of the vessel, with any contact impedances.
    currents, matrix : (K, L) and (M, L)
        Injections in A, and the map from potentials to readings.
    readings : (F, K, M)
        V, F frames; NaN where nothing was measured.
    depth : float
        See `MeasurementModel`.
    conductivity : float, optional
        σ in S/m if it is known.
    correction : "offset" or "gain"
        Treatment of the misfit of the fitted model; see `Calibration`.
    noise : VoltageNoise, optional
        Default: from the scatter of the frames, or else from the misfit.
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
    known = np.isfinite(readings)
    used = known.any(axis=0)
    if not used.any():
        raise ValueError("readings must hold numbers, got NaN only")
    count = np.maximum(known.sum(axis=0), 1)
    mean = np.where(known, readings, 0.0).sum(axis=0) / count
    if not mean.any():
        raise ValueError("readings must differ from each other, got 0 V everywhere")
    driven = currents / depth

    def model(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return readings (K, M) in V for σ = 1/ρ and contacts ζ = z σ, with x = (ln ρ, mean of
        ln ζ, deviations from it), and their derivatives by x (2 + L, K, M)."""
        contacts = np.exp(x[1] + x[2:])
        vessel = electrodes.with_contacts(contacts)
        R, by_contact = vessel.contact_derivatives(np.ones(vessel.mesh.n_nodes))
        by_contact *= contacts[:, None, None]
        by_x = np.exp(x[0]) * np.concatenate([R[None], by_contact.sum(axis=0)[None], by_contact])
        slopes = driven @ by_x @ matrix.T
        return slopes[0], slopes

    level = float(np.log(CONTACT_PRIOR_MEAN * electrode_sizes(electrodes).mean()))
    expected = np.array([0.0, level, *[0.0] * L])
    start, _ = model(expected)
    weight = used / FIT_NOISE.std(np.where(used, mean, 1.0))
    scale = float((weight**2 * start * mean).sum() / (weight**2 * start**2).sum())
    if scale <= 0:
        raise ValueError("readings must have the sign of the model's, got the opposite: turn the "
                         "sign of the currents or of the measurement matrix, or the order in which "
                         "readings count electrodes")
    expected[0] = np.log(scale)
    prior = np.diag([0.0, 1.0 / CONTACT_PRIOR_LOG_STD, *[1.0 / CONTACT_BETWEEN_LOG_STD] * L])

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.concatenate([(weight * (model(x)[0] - mean))[used], prior @ (x - expected)])

    def jacobian(x: np.ndarray) -> np.ndarray:
        return np.vstack([(weight * model(x)[1])[:, used].T, prior])

    x = expected
    for _ in range(2):                       # the second fit has the weights of the first misfit
        x = least_squares(residuals, x, jacobian, loss="soft_l1", xtol=1e-8, ftol=1e-8).x
        slopes = jacobian(x)
        computed, _ = model(x)
        misfit = _fit_noise((mean - computed)[used]**2, np.abs(mean[used]))
        weight = used / misfit.std(mean)
    repeated = bool(count.max() > 1)
    from_repeats = noise is not None or repeated
    if noise is None:
        noise = _repeat_noise(readings, mean, used, count) if repeated else misfit
    fitted = float(np.exp(-x[0]))                                   # σ if the gain is 1
    sigma, gain = (fitted, 1.0) if conductivity is None else (conductivity, conductivity / fitted)
    covariance = np.linalg.inv(slopes.T @ slopes)
    of_contacts = np.hstack([np.ones((L, 2)), np.eye(L)])           # ln z = ln ρ + mean + δ
    contact_std = np.sqrt(np.einsum("lp,pq,lq->l", of_contacts, covariance, of_contacts))
    return Calibration(sigma, float(np.sqrt(covariance[0, 0])), np.exp(x[1] + x[2:]) / sigma,
                       contact_std, gain, noise, from_repeats, np.where(used, mean, np.nan),
                       computed, correction)


def electrode_misfits(calibration: Calibration, matrix: np.ndarray) -> np.ndarray:
    """(L,) V, RMS misfit of the homogeneous model at the readings of each electrode; ``matrix``
    (M, L) maps potentials to readings."""
    involved = (matrix != 0).astype(float)
    squares = np.nan_to_num(calibration.measured - calibration.computed)**2
    count = np.maximum((np.isfinite(calibration.measured) @ involved).sum(axis=0), 1.0)
    misfits: np.ndarray = np.sqrt((squares @ involved).sum(axis=0) / count)
    return misfits


def electrode_sizes(electrodes: CompleteElectrodeModel) -> np.ndarray:
    """(L,) length of each electrode in m in 2D, square root of its area in 3D."""
    sizes = []
    for facets in electrodes.electrodes:
        corners = electrodes.mesh.points[facets]
        edges = corners[:, 1:] - corners[:, :1]
        size = np.sqrt(np.linalg.det(edges @ edges.transpose(0, 2, 1))).sum()  # lengths, or areas·2
        sizes.append(size if edges.shape[1] == 1 else np.sqrt(0.5 * size))
    return np.array(sizes)


def _repeat_noise(readings: np.ndarray, mean: np.ndarray, used: np.ndarray,
                  count: np.ndarray) -> VoltageNoise:
    """Fit a noise model to the scatter of the frames."""
    difference = np.where(np.isfinite(readings), readings - mean, 0.0)
    repeated = used & (count > 1)
    variance = (difference**2).sum(axis=0)[repeated] / (count[repeated] - 1)
    return _fit_noise(variance, np.abs(mean[repeated]))


def noise_of_frames(frames: np.ndarray) -> VoltageNoise | None:
    """Fit a noise model to the third differences of frames (F, K, M) in V, in which slow changes
    cancel; None for fewer than `MIN_NOISE_FRAMES`."""
    if len(frames) < MIN_NOISE_FRAMES:
        return None
    values = frames[:, np.isfinite(frames).all(axis=0)]
    # robust to fast targets: the median of squares, 0.455 of their mean for a normal distribution
    variance = np.median(np.diff(values, n=3, axis=0)**2, axis=0) / 20 / 0.455
    return _fit_noise(variance, np.abs(values).mean(axis=0))


def _fit_noise(variance: np.ndarray, size: np.ndarray) -> VoltageNoise:
    """Fit std² = (relative·V)² + floor² to the variances of readings of these sizes by least
    squares of relative deviations, so that large and small readings count alike."""
    typical = variance.mean() * (0.1 + size**2 / np.mean(size**2))
    terms = np.stack([size**2, np.ones_like(size)], axis=1) / typical[:, None]
    (relative, floor), _ = nnls(terms, variance / typical)
    lowest = 1e-6 * size.max()
    return VoltageNoise(float(np.sqrt(relative)), 0.0, float(max(np.sqrt(floor), lowest)))
