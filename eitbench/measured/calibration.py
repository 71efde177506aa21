"""Calibration on homogeneous fluid: conductivity, contact impedances, gain and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares, nnls

from eitbench import _check
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.physics.observation import VoltageNoise

CORRECTIONS = ("offset", "gain", "none")
CONTACT_PRIOR_MEAN = 0.1
"""Prior mean of z σ relative to the electrode's length."""
CONTACT_PRIOR_LOG_STD = 2.0
"""Prior standard deviation of the mean of ln z σ."""
CONTACT_BETWEEN_LOG_STD = 0.5
"""Prior standard deviation of ln z_l relative to the mean of all electrodes."""
FIT_NOISE = VoltageNoise(relative=0.01, relative_to_max=0.001)
"""Noise that weights the measurements in the first fit."""
MIN_NOISE_FRAMES = 8


@dataclass(frozen=True, eq=False)
class Calibration:
    """Parameters of vessel and instrument, fitted to measurements of homogeneous fluid."""

    conductivity: float
    """σ in S/m"""
    conductivity_std: float
    """standard deviation of ln σ"""
    contact_impedance: np.ndarray
    """(L,) z in Ω·m²"""
    contact_impedance_std: np.ndarray
    """(L,) standard deviation of ln z"""
    gain: float
    """instrument gain, measured per true voltage; 1 unless the conductivity is specified"""
    noise: VoltageNoise
    """noise of one measurement"""
    noise_from_repeats: bool
    """whether the noise is the scatter of repeats or frames; else it includes the model error"""
    mean_voltages: np.ndarray
    """(K, M) V, mean of the frames; NaN where nothing was measured"""
    model_voltages: np.ndarray
    """(K, M) V of the fitted model"""
    correction: str = "offset"
    """one of `CORRECTIONS`, for the misfit of the fitted model"""

    @property
    def offset(self) -> np.ndarray:
        """(K, M) V subtracted from measurements, 0 where nothing was measured: the mean
        approximation error of the model (Kaipio & Somersalo 2005)."""
        if self.correction != "offset":
            return np.zeros_like(self.mean_voltages)
        return np.nan_to_num(self.mean_voltages - self.model_voltages)

    @property
    def channel_gain(self) -> np.ndarray:
        """(K, M) ratio of each measurement to the model for the correction "gain", else 1."""
        if self.correction != "gain":
            return np.ones_like(self.mean_voltages)
        return np.nan_to_num(self.mean_voltages / self.model_voltages, nan=1.0)


def calibrate(electrodes: CompleteElectrodeModel, currents: np.ndarray, matrix: np.ndarray,
              voltages: np.ndarray, *, depth: float = 1.0, conductivity: float | None = None,
              correction: str = "offset", noise: VoltageNoise | None = None) -> Calibration:
    """Fit σ and z_l to homogeneous fluid by Gauss–Newton in their logarithms.

    A prior draws contact impedances to their common mean, and outliers have less weight. Voltages
    scale as gain/σ at a given σz, so the gain is fitted only if the ``conductivity`` is specified.
    ``ValueError`` names an argument of the wrong shape, and voltages without numbers or with the
    wrong sign.

    Parameters
    ----------
    electrodes : CompleteElectrodeModel
        Electrode model of the vessel, with any contact impedances.
    currents, matrix, depth
        As in `MeasurementModel`.
    voltages : (F, K, M)
        V, F frames; NaN where nothing was measured.
    conductivity : float, optional
        σ in S/m if it is known.
    correction : "offset", "gain" or "none"
        Treatment of the misfit of the fitted model; see `Calibration`.
    noise : VoltageNoise, optional
        Default: fitted to the scatter of the frames, or of a single frame to the misfit.
    """
    if correction not in CORRECTIONS:
        raise ValueError(f"correction must be one of {', '.join(CORRECTIONS)}, got {correction!r}")
    L = electrodes.n_electrodes
    currents = _check.array("currents", currents, (None, L), units="A")
    matrix = _check.array("matrix", matrix, (None, L))
    voltages = np.asarray(voltages, dtype=float)
    if voltages.ndim != 3 or voltages.shape[1:] != (len(currents), len(matrix)):
        raise ValueError("voltages must have shape (F, K, M) with K = "
                         f"{len(currents)} and M = {len(matrix)}, got {voltages.shape}")
    finite = np.isfinite(voltages)
    used = finite.any(axis=0)
    if not used.any():
        raise ValueError("voltages must hold numbers, got NaN only")
    count = np.maximum(finite.sum(axis=0), 1)
    mean = np.where(finite, voltages, 0.0).sum(axis=0) / count
    if not mean.any():
        raise ValueError("voltages must differ from each other, got 0 V everywhere")
    plane_currents = currents / depth

    def model(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return voltages (K, M) in V and their derivatives by x, (2 + L, K, M).

        σ = 1/ρ and contacts ζ = z σ, with x = (ln ρ, mean of ln ζ, deviations from that mean).
        """
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
    """Return (L,) V, the RMS misfit of the homogeneous model in the measurements of each electrode;
    ``matrix`` (M, L) maps potentials to measured voltages."""
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
    """Fit a noise model to the third differences of frames (F, K, M) in V, in which slow changes
    cancel; None for fewer than `MIN_NOISE_FRAMES`."""
    if len(frames) < MIN_NOISE_FRAMES:
        return None
    squares = np.diff(frames, n=3, axis=0)**2
    used = np.isfinite(squares).any(axis=0)
    if not used.any():
        return None
    # robust to fast targets: the median of squares, 0.455 of their mean for a normal distribution
    variance = np.nanmedian(squares[:, used], axis=0) / 20 / 0.455
    return _fit_noise(variance, np.nanmean(np.abs(frames[:, used]), axis=0))


def _fit_noise(variance: np.ndarray, size: np.ndarray) -> VoltageNoise:
    """Fit std² = (relative·V)² + floor² to the variances of voltages of these sizes by least
    squares of relative deviations, which weight large and small voltages equally."""
    typical = variance.mean() * (0.1 + size**2 / np.mean(size**2))
    terms = np.stack([size**2, np.ones_like(size)], axis=1) / typical[:, None]
    (relative, floor), _ = nnls(terms, variance / typical)
    lowest = 1e-6 * size.max()
    return VoltageNoise(float(np.sqrt(relative)), 0.0, float(max(np.sqrt(floor), lowest)))
