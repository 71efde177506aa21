"""Calibration of vessel and instrument with measurements of homogeneous fluid: conductivity,
contact impedances, gain and noise.

Shapes: F frames, K injections, M measurements per injection, L electrodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from eitbench import _check
from eitbench.measured.measurements import check_voltages
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.physics.observation import VoltageNoise

CORRECTIONS = ("offset", "gain", "none")
"""Corrections of the misfit on homogeneous fluid; see `Calibration`."""
CONTACT_PRIOR_MEAN = 0.1
"""Prior value of z σ (contact impedance times conductivity, in m) divided by the size of the
electrode (`electrode_sizes`); dimensionless."""
CONTACT_PRIOR_LOG_STD = 2.0
"""Prior standard deviation of the mean of ln(z_l σ) over the electrodes l."""
CONTACT_BETWEEN_LOG_STD = 0.5
"""Prior standard deviation of the difference between ln z_l and its mean over the electrodes."""
FIT_NOISE = VoltageNoise(relative=0.01, relative_to_max=0.001)
"""Noise model for the weights of the first fit; the second uses the misfit of the first."""
MIN_NOISE_FRAMES = 8
"""Smallest number of frames for `noise_from_frames`."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """Parameters of vessel and instrument, fitted to measurements of homogeneous fluid."""

    conductivity: float
    """σ in S/m"""
    conductivity_std: float
    """standard deviation of ln σ, dimensionless"""
    contact_impedance: np.ndarray
    """(L,) z in Ω·m²"""
    contact_impedance_std: np.ndarray
    """(L,) standard deviation of ln z"""
    gain: float
    """gain of the instrument, measured voltage / true voltage; 1 unless σ was specified"""
    noise: VoltageNoise
    """noise model of a single measurement, not of the mean over frames"""
    noise_from_repeats: bool
    """True if the noise is given, or fitted to the variance between frames; False if it is fitted
    to the misfit of a single frame, which includes the model error"""
    mean_voltages: np.ndarray
    """(K, M) V, mean over the frames; NaN where no frame has a value"""
    model_voltages: np.ndarray
    """(K, M) V of the fitted model"""
    correction: str = "offset"
    """one of `CORRECTIONS`: "offset" subtracts the misfit on homogeneous fluid from measurements,
    the mean approximation error of the model (Kaipio & Somersalo 2005); "gain" divides each channel
    by its ratio of measured and model voltage; "none" corrects nothing"""


def calibrate(electrodes: CompleteElectrodeModel, currents: np.ndarray, matrix: np.ndarray,
              voltages: np.ndarray, *, depth: float = 1.0, conductivity: float | None = None,
              correction: str = "offset", noise: VoltageNoise | None = None) -> Calibration:
    """Fit conductivity σ and contact impedances z_l to voltages of homogeneous fluid, by
    Gauss–Newton in their logarithms.

    The prior of the z_l has a common mean and penalises deviations from it; a robust loss (soft L1)
    reduces the weight of outliers. At given products z_l σ the voltages are proportional to gain/σ,
    so only this ratio can be fitted: σ with gain 1, or the gain if ``conductivity`` is specified.
    ``ValueError`` names an argument of the wrong shape, and voltages that are all NaN, all 0, or of
    the wrong sign.

    Parameters
    ----------
    electrodes : CompleteElectrodeModel
        Electrode model of the vessel, with any contact impedances.
    currents, matrix, depth
        As in `MeasurementModel`.
    voltages : (F, K, M)
        Measurements in V; NaN where a value is missing.
    conductivity : float, optional
        σ in S/m, if it was measured otherwise.
    correction : "offset", "gain" or "none"
        Treatment of the misfit of the fitted model; see `Calibration`.
    noise : VoltageNoise, optional
        Default: fitted to the variance between frames, or to the misfit of a single frame.
    """
    _check.choice("correction", correction, CORRECTIONS)
    L = electrodes.n_electrodes
    currents = _check.array("currents", currents, (None, L), units="A")
    matrix = _check.array("matrix", matrix, (None, L))
    voltages = check_voltages("voltages", voltages, (None, len(currents), len(matrix)))
    finite = np.isfinite(voltages)
    used = finite.any(axis=0)
    count = np.maximum(finite.sum(axis=0), 1)
    mean = np.where(finite, voltages, 0.0).sum(axis=0) / count
    if not mean.any():
        raise ValueError("voltages must differ from each other, got 0 V everywhere")
    plane_currents = currents / depth

    def model(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return voltages (K, M) in V and their derivatives by x, (2 + L, K, M).

        x = (ln ρ, mean of ln ζ_l, deviations of the ln ζ_l from this mean), with the resistivity
        ρ = 1/σ and contacts ζ_l = z_l σ.
        """
        return at(x.tobytes())

    @lru_cache(maxsize=1)           # residuals and Jacobian need the same point
    def at(numbers: bytes) -> tuple[np.ndarray, np.ndarray]:
        x = np.frombuffer(numbers)
        contacts = np.exp(x[1] + x[2:])
        vessel = electrodes.with_contacts(contacts)
        R, by_contact = vessel.contact_derivatives(np.ones(vessel.mesh.n_nodes))
        by_contact *= contacts[:, None, None]
        by_x = np.exp(x[0]) * np.concatenate([R[None], by_contact.sum(axis=0)[None], by_contact])
        derivatives = plane_currents @ by_x @ matrix.T
        return derivatives[0], derivatives

    log_contact = float(np.log(CONTACT_PRIOR_MEAN * electrode_sizes(electrodes).mean()))
    prior_mean = np.array([0.0, log_contact, *[0.0] * L])
    initial, _ = model(prior_mean)
    weight = used / FIT_NOISE.std(np.where(used, mean, 1.0))
    scale = float((weight**2 * initial * mean).sum() / (weight**2 * initial**2).sum())
    if scale <= 0:
        raise ValueError("voltages must have the sign of the model's, got the opposite: change the "
                         "sign of the currents or of the measurement matrix, or the order in which "
                         "measurements number the electrodes")
    prior_mean[0] = np.log(scale)
    root_precision = np.diag([0.0, 1.0 / CONTACT_PRIOR_LOG_STD,
                              *[1.0 / CONTACT_BETWEEN_LOG_STD] * L])

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.concatenate([(weight * (model(x)[0] - mean))[used],
                               root_precision @ (x - prior_mean)])

    def jacobian(x: np.ndarray) -> np.ndarray:
        return np.vstack([(weight * model(x)[1])[:, used].T, root_precision])

    from scipy.optimize import least_squares  # lazy import: takes half a second
    x = prior_mean
    for _ in range(2):                   # the second fit has weights from the misfit of the first
        x = least_squares(residuals, x, jacobian, loss="soft_l1", xtol=1e-8, ftol=1e-8).x
        J = jacobian(x)
        model_voltages, _ = model(x)
        misfit = _fit_noise((mean - model_voltages)[used]**2, np.abs(mean[used]))
        weight = used / misfit.std(mean)
    repeated = used & (count > 1)
    from_repeats = noise is not None or bool(repeated.any())
    if noise is None and from_repeats:
        squares = (np.where(finite, voltages - mean, 0.0)**2).sum(axis=0)[repeated]
        noise = _fit_noise(squares / (count[repeated] - 1), np.abs(mean[repeated]))
    fitted = float(np.exp(-x[0]))                                   # σ if the gain is 1
    sigma, gain = (fitted, 1.0) if conductivity is None else (conductivity, conductivity / fitted)
    measured = np.where(used, mean, np.nan)
    covariance = np.linalg.inv(J.T @ J)
    to_log_contact = np.hstack([np.ones((L, 2)), np.eye(L)])        # ln z = ln ρ + mean + δ
    contact_std = np.sqrt(np.einsum("lp,pq,lq->l", to_log_contact, covariance, to_log_contact))
    return Calibration(sigma, float(np.sqrt(covariance[0, 0])), np.exp(x[1] + x[2:]) / sigma,
                       contact_std, gain, noise or misfit, from_repeats, measured, model_voltages,
                       correction)


def electrode_misfits(calibration: Calibration, matrix: np.ndarray) -> np.ndarray:
    """Return (L,) V, for each electrode the RMS misfit of the homogeneous model over the
    measurements that involve it; ``matrix`` (M, L) maps potentials to measured voltages."""
    involved = (matrix != 0).astype(float)
    squares = np.nan_to_num(calibration.mean_voltages - calibration.model_voltages)**2
    count = np.maximum((np.isfinite(calibration.mean_voltages) @ involved).sum(axis=0), 1.0)
    misfits: np.ndarray = np.sqrt((squares @ involved).sum(axis=0) / count)
    return misfits


def electrode_sizes(electrodes: CompleteElectrodeModel) -> np.ndarray:
    """Return (L,) m: the length of each electrode in 2D, the square root of its area in 3D."""
    sizes = []
    for facets in electrodes.electrodes:
        corners = electrodes.mesh.points[facets]
        edges = corners[:, 1:] - corners[:, :1]
        size = np.sqrt(np.linalg.det(edges @ edges.transpose(0, 2, 1))).sum()  # lengths, or areas·2
        sizes.append(size if edges.shape[1] == 1 else np.sqrt(0.5 * size))
    return np.array(sizes)


def noise_from_frames(frames: np.ndarray) -> VoltageNoise | None:
    """Fit a noise model to the third differences in time of frames (F, K, M) in V, in which slow
    changes cancel. Return None for fewer than `MIN_NOISE_FRAMES` frames, or without values."""
    if len(frames) < MIN_NOISE_FRAMES:
        return None
    squares = np.diff(frames, n=3, axis=0)**2
    used = np.isfinite(squares).any(axis=0)
    if not used.any():
        return None
    # the median is robust to fast targets; for a normal distribution it is 0.455 of the mean, and
    # third differences have 20 times the variance of a measurement
    variance = np.nanmedian(squares[:, used], axis=0) / 20 / 0.455
    return _fit_noise(variance, np.nanmean(np.abs(frames[:, used]), axis=0))


def _fit_noise(variance: np.ndarray, size: np.ndarray) -> VoltageNoise:
    """Fit std² = (relative·size)² + floor² to the ``variance`` in V² of voltages with the absolute
    values ``size`` in V, by least squares of relative deviations, which weight large and small
    voltages equally."""
    typical = variance.mean() * (0.1 + size**2 / np.mean(size**2))
    terms = np.stack([size**2, np.ones_like(size)], axis=1) / typical[:, None]
    from scipy.optimize import nnls  # lazy import: takes half a second
    (relative, floor), _ = nnls(terms, variance / typical)
    lowest = 1e-6 * size.max()
    return VoltageNoise(float(np.sqrt(relative)), 0.0, float(max(np.sqrt(floor), lowest)))
