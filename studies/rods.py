"""Rods that were moved in real tanks, as it is said of them: `python studies/rods.py FOLDER`.

FOLDER holds EIDORS' sample data, iirc_data_2006.mat and montreal_data_1995.mat. Nobody says where a
rod was at which time. It was moved "in circle around" a tank in IIRC's and Montreal's first record,
and "diametrically across" in Montreal's second. Prints the circle or line that is nearest to where
estimates have the rod and by how much they are off it, and draws docs/rods.png; ten minutes.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from scipy.optimize import least_squares
from thesis.common import bare, save

from eitbench.bench.runner import run_on_measurements
from eitbench.envs.measured import MeasuredEnv
from eitbench.measured import read
from eitbench.measured.cases import read_case

ROOT = Path(__file__).parents[1]
FIRST = 3
"""frames that a filter is given to find the rod"""
PART = 0.5
"""of the extreme of ln c, from which on it is the rod's"""


class Rod(NamedTuple):
    """A record of one."""

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
        record = read(folder / case.file, name=rod.variable)
        env = MeasuredEnv(record, dict(case.vessel), **case.options)
        ends = np.arange(FIRST * record.frame, len(record.readings) + 1, record.frame)
        run = run_on_measurements(env, "log_steady_filter", kept=set(ends.tolist()))
        path = np.array([middle(env, estimate) for estimate in run.mean])
        nearest = circle(path) if rod.is_round else line(path)
        times = record.times[run.steps - 1]
        print(f"{rod.title}: {described(path, nearest, rod.is_round)}; withheld RMSE "
              f"{run.withheld_rmse:.2f} noise std", flush=True)
        radius = 100.0 * env.vessel.shape.radius
        axes.add_patch(Circle((0.0, 0.0), radius, fill=False, color="0.4"))
        axes.plot(*nearest.T, color="#d1495b", linewidth=1.2)
        shown = axes.scatter(*path.T, c=times, s=14, zorder=3)
        figure.colorbar(shown, ax=axes, label="time / s", shrink=0.7)
        axes.set(title=rod.title, xlabel="x / cm", aspect="equal", xlim=(-radius, radius),
                 ylim=(-radius, radius))
        bare(axes)
    save(figure, ROOT / "docs" / "rods.png")


def middle(env: MeasuredEnv, estimate: np.ndarray) -> np.ndarray:
    """(2,) cm, of where it conducts less than the tank's median by half of the extreme, in
    decades."""
    u = np.log(estimate)
    less = np.maximum(np.median(u) - u, 0.0)
    less[less < PART * less.max()] = 0.0
    return np.asarray(100.0 * less @ env.task.mesh.points / less.sum())


def circle(path: np.ndarray) -> np.ndarray:
    """(361, 2) cm, the circle that is nearest to a path."""
    def off(x: np.ndarray) -> np.ndarray:
        return np.asarray(np.hypot(*(path - x[:2]).T) - x[2])

    x, y, radius = least_squares(off, [0.0, 0.0, 5.0], loss="soft_l1").x
    angle = np.radians(np.arange(361))
    return np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=1)


def line(path: np.ndarray) -> np.ndarray:
    """(2, 2) cm, the ends of the line that is nearest to a path."""
    centre = path.mean(axis=0)
    way = np.linalg.svd(path - centre)[2][0]
    along = (path - centre) @ way
    return np.asarray(centre + np.outer([along.min(), along.max()], way))


def described(path: np.ndarray, nearest: np.ndarray, is_round: bool) -> str:
    """In words: where the rod went, and by how much its places are off that in cm, rms."""
    if not is_round:
        length = np.linalg.norm(nearest[1] - nearest[0])
        way = (nearest[1] - nearest[0]) / length
        across = np.array([-way[1], way[0]])
        return (f"{len(path)} frames, off a line of {length:.1f} cm that passes the middle at "
                f"{abs(nearest[0] @ across):.1f} cm by {_rms((path - nearest[0]) @ across):.1f} cm")
    centre = nearest[:-1].mean(axis=0)
    radius = float(np.linalg.norm(nearest[0] - centre))
    off = np.hypot(*(path - centre).T) - radius
    angle = np.unwrap(np.arctan2(*(path - centre).T[::-1]))
    frame = np.arange(len(path))
    rate, start = np.polyfit(frame, angle, 1)
    return (f"{len(path)} frames, off a circle of {radius:.1f} cm about ({centre[0]:.1f}, "
            f"{centre[1]:.1f}) cm by {_rms(off):.1f} cm; a turn in {2 * np.pi / abs(rate):.0f} "
            f"frames, off an even one by {_rms(radius * (angle - start - rate * frame)):.1f} cm")


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
