"""Segmentation of an estimate in a round tank, and its score by ground truth.

The Kuopio Tomography Challenge 2023 (KTC; Räsänen et al., "Kuopio Tomography Challenge 2023 open
electrical impedance tomographic dataset") defines the score: similarity of two segmentations.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.ndimage import center_of_mass, gaussian_filter, label

from eitbench.measured.matlab import load_variables
from eitbench.measured.vessel import VesselConfig
from eitbench.worlds.task import Task
from eitbench.worlds.vessels import RoundTank

PIXELS = 256
"""Along the diameter of the tank."""
WATER, RESISTIVE, CONDUCTIVE = 0, 1, 2
"""Classes of pixels."""
SSIM_SIGMA, SSIM_RADIUS = 80.0, 160
"""Pixels, standard deviation and radius of the Gaussian window."""
SSIM_CONSTANTS = 1e-4, 9e-4
MIN_LOG_CONTRAST = 1.0
"""Smallest |ln c/c̄| of an inclusion, chosen by ``python studies/segment.py``."""
EXTREME_FRACTION = 0.5
"""Fraction of the extreme above which a pixel belongs to an inclusion; chosen by the same study."""
MIN_PIXELS = 30
"""Smallest area of an inclusion whose centroid is used."""


def ktc_score(truth: np.ndarray, estimate: np.ndarray) -> float:
    """Return the mean structural similarity of the conductive and the resistive inclusions of two
    segmentations (256, 256); 1 if equal."""
    return float(np.mean([_similarity(np.equal(truth, each), np.equal(estimate, each))
                          for each in (RESISTIVE, CONDUCTIVE)]))


def segment(vessel: VesselConfig, task: Task, estimate: np.ndarray,
            fraction: float = EXTREME_FRACTION,
            min_contrast: float = MIN_LOG_CONTRAST) -> np.ndarray:
    """Classify the pixels (256, 256) of an estimate (n,) in mol/m³; row 0 is the top.

    In an inclusion ln(c/c̄) exceeds a ``fraction`` of its extreme in the tank, and the extreme
    exceeds ``min_contrast``; c̄ is the calibrated background. ``ValueError`` if the vessel is not
    a round tank.
    """
    radius = require_round_tank(vessel).radius
    side = (np.arange(PIXELS) + 0.5) / PIXELS * 2.0 - 1.0
    x, y = (each.ravel() * radius for each in np.meshgrid(side, -side))
    inside = np.hypot(x, y) < 0.995 * radius                    # the mesh's wall is a polygon
    background = task.expected_concentration
    c = np.maximum(estimate, 1e-6 * background)
    field = np.zeros(PIXELS**2)
    field[inside] = (task.mesh.interpolation_to(np.stack([x[inside], y[inside]], axis=1))
                     @ np.log(c / background))
    classes = np.full(PIXELS**2, WATER)
    for inclusion, sign in ((RESISTIVE, -1.0), (CONDUCTIVE, 1.0)):
        extreme = float((sign * field).max())
        if extreme > min_contrast:
            classes[sign * field > fraction * extreme] = inclusion
    return classes.reshape(PIXELS, PIXELS)


def centroid_errors(vessel: VesselConfig, truth: np.ndarray, estimate: np.ndarray) -> list[float]:
    """Return the distances in m from the centroid of each true inclusion to the nearest estimated
    one of its class; infinite if that class is missing."""
    pixel = 2.0 * require_round_tank(vessel).radius / PIXELS
    errors = []
    for kind in (RESISTIVE, CONDUCTIVE):
        centroids = _centroids(estimate == kind)
        errors += [pixel * float(min((np.hypot(*(each - other)) for other in centroids),
                                     default=np.inf))
                   for each in _centroids(truth == kind)]
    return errors


def read_truth(path: Path | str) -> np.ndarray:
    """Read a segmentation (256, 256) of 0 (water), 1 (resistive) and 2 (conductive): variable
    ``truth`` of a .mat file. ``ValueError`` names the file and the error."""
    truth = np.asarray(load_variables(Path(path), "truth")["truth"])
    if truth.shape != (PIXELS, PIXELS) or not np.isin(truth, (WATER, RESISTIVE, CONDUCTIVE)).all():
        raise ValueError(f"{path}: truth must be {PIXELS} × {PIXELS} numbers 0, 1 and 2, got "
                         f"{truth.shape} with {np.unique(truth)[:5]}")
    return truth.astype(int)


def require_round_tank(vessel: VesselConfig) -> RoundTank:
    """Return the vessel's shape; ``ValueError`` if it is not a round tank."""
    if not isinstance(vessel.shape, RoundTank):
        raise ValueError("vessel must be a circle to use a ground truth, got a "
                         f"{type(vessel.shape).__name__}")
    return vessel.shape


def _centroids(mask: np.ndarray) -> list[np.ndarray]:
    inclusions, count = label(mask)
    return [np.array(center_of_mass(inclusions == k)) for k in range(1, count + 1)
            if (inclusions == k).sum() >= MIN_PIXELS]


def _similarity(truth: np.ndarray, estimate: np.ndarray) -> float:
    """Return the mean structural similarity of two images with values from 0 to 1."""
    a, b = truth.astype(float), estimate.astype(float)
    mean_a, mean_b = _smooth(a), _smooth(b)
    var_a, var_b = _smooth(a**2) - mean_a**2, _smooth(b**2) - mean_b**2
    covariance = _smooth(a * b) - mean_a * mean_b
    c1, c2 = SSIM_CONSTANTS
    numerator = (2.0 * mean_a * mean_b + c1) * (2.0 * covariance + c2)
    denominator = (mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2)
    return float((numerator / denominator).mean())


def _smooth(image: np.ndarray) -> np.ndarray:
    """Return the weighted mean under the window; pixels outside the image have no weight."""
    weighted, weight = (gaussian_filter(each, SSIM_SIGMA, mode="constant", radius=SSIM_RADIUS)
                        for each in (image, np.ones_like(image)))
    return np.asarray(weighted / weight)
