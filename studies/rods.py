"""Estimated paths of rods in real tanks: `python studies/rods.py FOLDER`.

FOLDER holds EIDORS' sample data, iirc_data_2006.mat and montreal_data_1995.mat. The positions
of the rods were not published. The rod was moved "in circle around" a tank in IIRC's and Montreal's
first sequence, and "diametrically across" in Montreal's second. Prints the circle or line that fits
the estimated positions best and the RMS distance from it, and draws docs/rods.png; ten minutes.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from scipy.optimize import least_squares
from thesis.common import despine, save_figure

from eitbench.bench.runner import run_on_measurements
from eitbench.envs.measured import MeasuredEnv
from eitbench.measured import read
from eitbench.measured.cases import read_case

ROOT = Path(__file__).parents[1]
FIRST_FRAME = 3
"""Frame of the first position; the filter needs some frames of warm-up."""
EXTREME_FRACTION = 0.5
"""Threshold of the rod, relative to the extreme of ln c."""


class Rod(NamedTuple):
    """Measurement sequence of a rod."""

    title: str
    case: str
    variable: str
    is_round: bool


RODS = [Rod("IIRC, round the tank", "iirc", "v_rotate", True),
        Rod("Montreal, round the tank", "montreal", "zc_demo3", True),
        Rod("Montreal, across the tank", "montreal", "zc_demo4", False)]


def main(folder: Path) -> None:
    figure = Figure(figsize=(10.5, 3.9), dpi=110, layout="constrained")
    for axes, rod in zip(figure.subplots(1, len(RODS)), RODS, strict=True):
        case = read_case(rod.case)
        measurements = read(folder / case.file, name=rod.variable)
        env = MeasuredEnv(measurements, dict(case.vessel), **case.options)
        frame = measurements.frame_length
        ends = np.arange(FIRST_FRAME * frame, len(measurements.voltages) + 1, frame)
        run = run_on_measurements(env, "log_steady_filter", kept=set(ends.tolist()))
        path = np.array([rod_centroid(env, estimate) for estimate in run.mean])
        nearest = fit_circle(path) if rod.is_round else fit_line(path)
        times = measurements.times[run.steps - 1]
        print(f"{rod.title}: {describe_fit(path, nearest, rod.is_round)}; withheld RMSE "
              f"{run.withheld_rmse:.2f} noise std", flush=True)
        radius = 100.0 * env.vessel.shape.radius
        axes.add_patch(Circle((0.0, 0.0), radius, fill=False, color="0.4"))
        axes.plot(*nearest.T, color="#d1495b", linewidth=1.2)
        mappable = axes.scatter(*path.T, c=times, s=14, zorder=3)
        figure.colorbar(mappable, ax=axes, label="time / s", shrink=0.7)
        axes.set(title=rod.title, xlabel="x / cm", aspect="equal", xlim=(-radius, radius),
                 ylim=(-radius, radius))
        despine(axes)
    save_figure(figure, ROOT / "docs" / "rods.png")


def rod_centroid(env: MeasuredEnv, estimate: np.ndarray) -> np.ndarray:
    """Return the centroid (2,) in cm of the region with the lowest ln c, relative to the median."""
    u = np.log(estimate)
    deficit = np.maximum(np.median(u) - u, 0.0)
    deficit[deficit < EXTREME_FRACTION * deficit.max()] = 0.0
    return np.asarray(100.0 * deficit @ env.task.mesh.points / deficit.sum())


def fit_circle(path: np.ndarray) -> np.ndarray:
    """Return points (361, 2) in cm of the circle that fits a path best."""
    def residual(x: np.ndarray) -> np.ndarray:
        return np.asarray(np.hypot(*(path - x[:2]).T) - x[2])

    x, y, radius = least_squares(residual, [0.0, 0.0, 5.0], loss="soft_l1").x
    angle = np.radians(np.arange(361))
    return np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=1)


def fit_line(path: np.ndarray) -> np.ndarray:
    """Return the ends (2, 2) in cm of the line that fits a path best."""
    centre = path.mean(axis=0)
    direction = np.linalg.svd(path - centre)[2][0]
    along = (path - centre) @ direction
    return np.asarray(centre + np.outer([along.min(), along.max()], direction))


def describe_fit(path: np.ndarray, nearest: np.ndarray, is_round: bool) -> str:
    """Describe the fitted circle or line and the RMS distance of the positions from it."""
    if not is_round:
        length = np.linalg.norm(nearest[1] - nearest[0])
        direction = (nearest[1] - nearest[0]) / length
        across = np.array([-direction[1], direction[0]])
        return (f"{len(path)} frames, line of {length:.1f} cm at {abs(nearest[0] @ across):.1f} cm "
                f"from the centre, RMS distance {_rms((path - nearest[0]) @ across):.1f} cm")
    centre = nearest[:-1].mean(axis=0)
    radius = float(np.linalg.norm(nearest[0] - centre))
    distance = np.hypot(*(path - centre).T) - radius
    angle = np.unwrap(np.arctan2(*(path - centre).T[::-1]))
    frame = np.arange(len(path))
    rate, start = np.polyfit(frame, angle, 1)
    return (f"{len(path)} frames, circle of {radius:.1f} cm about ({centre[0]:.1f}, "
            f"{centre[1]:.1f}) cm, RMS distance {_rms(distance):.1f} cm; one turn in "
            f"{2 * np.pi / abs(rate):.0f} frames, RMS distance from uniform motion "
            f"{_rms(radius * (angle - start - rate * frame)):.1f} cm")


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
