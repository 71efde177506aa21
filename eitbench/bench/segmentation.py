"""Where a truth is known as a picture of bodies that conduct better or worse than what is around.

The score is that of the Kuopio Tomography Challenge 2023 (Räsänen et al., "Kuopio Tomography
Challenge 2023 open electrical impedance tomographic dataset"): how alike two segmentations are.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import center_of_mass, label

from eitbench.data.measured.matlab import needed, variables
from eitbench.worlds.vessels import RoundTank

if TYPE_CHECKING:
    from eitbench.bench.measured import Played
    from eitbench.envs.measured import MeasuredEnv

PIXELS = 256
"""of a picture's side, over which the tank's diameter goes"""
WATER, WORSE, BETTER = 0, 1, 2
"""Classes of pixels."""
WINDOW, WIDEST = 80.0, 160
"""Standard deviation of the Gaussian window, and how far it goes, in pixels."""
STABLE = 1e-4, 9e-4
"""What keeps the similarity finite where there is nothing."""
LEAST = 1.0
"""|ln c/c̄| of a body at least, and"""
PART = 0.5
"""of its extreme, from which on a pixel is its own: chosen by ``python studies/segment.py``."""
SMALLEST = 30
"""pixels of a body of which the middle is asked for"""


def ktc_score(truth: np.ndarray, found: np.ndarray) -> float:
    """How alike two segmentations (256, 256) are, 1 if they are the same: mean of the structural
    similarities of the bodies that conduct better, and of those that conduct worse."""
    return float(np.mean([_similarity(np.equal(truth, each), np.equal(found, each))
                          for each in (WORSE, BETTER)]))


def segmented(env: MeasuredEnv, estimate: np.ndarray, part: float = PART,
              least: float = LEAST) -> np.ndarray:
    """(256, 256) classes of an estimate (n,) in mol/m³: row 0 is the top, as in a photograph.

    A body is where ln(c/c̄) has more than ``part`` of its extreme in the tank, if that is more than
    ``least``; c̄ is what homogeneous fluid has. ``ValueError`` if the vessel is no round tank.
    """
    mesh = env.task.mesh
    side = (np.arange(PIXELS) + 0.5) / PIXELS * 2.0 - 1.0
    x, y = (each.ravel() * check_tank(env).radius for each in np.meshgrid(side, -side))
    inside = np.hypot(x, y) < 0.995 * check_tank(env).radius        # the mesh's wall is a polygon
    c = np.maximum(estimate, 1e-6 * env.task.expected_concentration)
    field = np.zeros(PIXELS**2)
    field[inside] = (mesh.interpolation_to(np.stack([x[inside], y[inside]], axis=1))
                     @ np.log(c / env.task.expected_concentration))
    classes = np.full(PIXELS**2, WATER)
    for kind, sign in ((WORSE, -1.0), (BETTER, 1.0)):
        extreme = float((sign * field).max())
        if extreme > least:
            classes[sign * field > part * extreme] = kind
    return classes.reshape(PIXELS, PIXELS)


def scored_by_truth(env: MeasuredEnv, played: Played, truth: np.ndarray) -> dict[str, float]:
    """``ktc``, the challenge's score of the last estimate."""
    return {"ktc": ktc_score(truth, segmented(env, played.mean[-1]))}


def distances(env: MeasuredEnv, truth: np.ndarray, found: np.ndarray) -> list[float]:
    """m from the middle of each body of the truth to that of the nearest one found of its class;
    infinite where there is none."""
    pixel = 2.0 * check_tank(env).radius / PIXELS
    off = []
    for kind in (WORSE, BETTER):
        theirs, ours = _middles(truth == kind), _middles(found == kind)
        off += [pixel * float(min((np.hypot(*(middle - each)) for each in ours), default=np.inf))
                for middle in theirs]
    return off


def read_truth(path: Path | str) -> np.ndarray:
    """A segmentation (256, 256) of 0 (water), 1 (conducts worse) and 2 (better): variable ``truth``
    of a .mat file. ``ValueError`` naming the file and what is wrong with it."""
    path = Path(path)
    truth = np.asarray(needed(variables(path), path, "truth")[0])
    if truth.shape != (PIXELS, PIXELS) or not np.isin(truth, (WATER, WORSE, BETTER)).all():
        raise ValueError(f"{path}: truth must be {PIXELS} × {PIXELS} numbers 0, 1 and 2, got "
                         f"{truth.shape} with {np.unique(truth)[:5]}")
    return truth.astype(int)


def check_tank(env: MeasuredEnv) -> RoundTank:
    """The round tank that an environment has; ``ValueError`` if it is another vessel."""
    shape = env.vessel.shape
    if not isinstance(shape, RoundTank):
        raise ValueError("vessel must be a circle where there is a truth, got a "
                         f"{type(shape).__name__}")
    return shape


def _middles(there: np.ndarray) -> list[np.ndarray]:
    bodies, count = label(there)
    return [np.array(center_of_mass(bodies == k)) for k in range(1, count + 1)
            if (bodies == k).sum() >= SMALLEST]


def _similarity(truth: np.ndarray, found: np.ndarray) -> float:
    """Mean structural similarity of two pictures in the range 0 to 1."""
    a, b = truth.astype(float), found.astype(float)
    mean_a, mean_b = _smooth(a), _smooth(b)
    var_a, var_b = _smooth(a**2) - mean_a**2, _smooth(b**2) - mean_b**2
    cross = _smooth(a * b) - mean_a * mean_b
    first, second = STABLE
    above = (2.0 * mean_a * mean_b + first) * (2.0 * cross + second)
    below = (mean_a**2 + mean_b**2 + first) * (var_a + var_b + second)
    return float((above / below).mean())


def _smooth(picture: np.ndarray) -> np.ndarray:
    """Mean under the window, of what lies within the picture."""
    apart = np.arange(PIXELS)[:, None] - np.arange(PIXELS)
    window = np.exp(-0.5 * (apart / WINDOW)**2) * (np.abs(apart) <= WIDEST)
    window /= window.sum(axis=1, keepdims=True)
    smooth: np.ndarray = window @ picture @ window.T
    return smooth
