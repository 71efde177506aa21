"""Estimates and photographs of bodies in a real tank: `python studies/kit4.py FOLDER`.

FOLDER holds KIT4's datamat_1_0.mat, datamat_2_3.mat, datamat_4_1.mat and datamat_4_4.mat (Hauptmann
et al. 2017, doi:10.5281/zenodo.1203914). Prints centroid errors and draws docs/kit4.png; half a
minute.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.ndimage import center_of_mass, label
from thesis.common import despine, save_figure

from eitbench.bench.runner import run_on_measurements
from eitbench.envs.measured import MeasuredEnv, case_env

ROOT = Path(__file__).parents[1]
RADIUS_CM = 14.0
PIXEL_CM = 0.1


class Body(NamedTuple):
    """A body in a photograph of the water surface, in cm, with an accuracy of about 2 mm."""

    outline: np.ndarray
    conducts: bool

    @property
    def centroid(self) -> np.ndarray:
        """Mean of the points of the outline."""
        return self.outline.mean(axis=0)


def round_body(x: float, y: float, radius: float, conducts: bool) -> Body:
    """Create a ring or a disk."""
    angle = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    outline = np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=1)
    return Body(outline, conducts)


BODIES = {
    "kit4-2.3": [round_body(6.3, 5.3, 2.4, True), round_body(3.55, -5.6, 3.8, True)],
    "kit4-4.1": [round_body(-0.9, 9.1, 2.4, True),
                 Body(np.array([[0.4, -0.1], [8.6, -2.1], [2.9, -8.4]]), False)],
    "kit4-4.4": [round_body(6.9, -0.4, 2.4, True), round_body(2.1, -5.7, 2.7, False)]}


def main(folder: Path) -> None:
    figure = Figure(figsize=(10.5, 3.9), dpi=110, layout="constrained")
    for axes, (name, bodies) in zip(figure.subplots(1, len(BODIES)), BODIES.items(), strict=True):
        _, number = name.split("-")
        env = case_env(name, folder / f"datamat_{number.replace('.', '_')}.mat")
        run = run_on_measurements(env, "log_map")
        estimate = np.log10(run.mean[-1] / env.task.expected_concentration)
        errors = [centroid_error(env, estimate, body) for body in bodies]
        print(f"{name}: centroid errors {', '.join(f'{each:.1f}' for each in errors)} cm; "
              f"withheld RMSE {run.withheld_rmse:.1f} noise std", flush=True)
        draw(axes, env, estimate, bodies, name)
    mappable = figure.axes[-1].collections[0]
    figure.colorbar(mappable, ax=figure.axes, label="conductivity / background (decades)")
    save_figure(figure, ROOT / "docs" / "kit4.png")


def centroid_error(env: MeasuredEnv, estimate: np.ndarray, body: Body) -> float:
    """Return the distance in cm of the body from the centroid of the region where the estimate
    exceeds half of its extreme near the body."""
    side = np.arange(-RADIUS_CM, RADIUS_CM + PIXEL_CM, PIXEL_CM)
    x, y = np.meshgrid(side, side)
    inside = np.hypot(x, y) < 0.99 * RADIUS_CM
    field = np.zeros_like(x)
    points = 1e-2 * np.stack([x[inside], y[inside]], axis=1)
    field[inside] = env.task.mesh.interpolation_to(points) @ estimate
    field *= 1.0 if body.conducts else -1.0
    near = np.hypot(x - body.centroid[0], y - body.centroid[1]) < 2.0
    regions, _ = label(field > 0.5 * field[near].max())
    region = np.bincount(regions[near & (regions > 0)]).argmax()
    row, column = center_of_mass(regions == region)
    return float(np.hypot(side[0] + PIXEL_CM * column - body.centroid[0],
                          side[0] + PIXEL_CM * row - body.centroid[1]))


def draw(axes: Axes, env: MeasuredEnv, estimate: np.ndarray, bodies: list[Body],
         title: str) -> None:
    """Draw the estimate and the outlines of the bodies."""
    x, y = 100.0 * env.task.mesh.points.T
    axes.tripcolor(x, y, env.task.mesh.cells, estimate, shading="gouraud", cmap="RdBu_r",
                   vmin=-1.6, vmax=1.6)
    for body in bodies:
        closed = np.vstack([body.outline, body.outline[:1]])
        axes.plot(*closed.T, color="k", linewidth=1.5)
    axes.set(title=title, xlabel="x / cm", aspect="equal")
    despine(axes)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
