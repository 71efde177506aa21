"""Bodies in a real tank, beside where photographs have them: `python studies/kit4.py FOLDER`.

FOLDER holds KIT4's datamat_1_0.mat, datamat_2_3.mat, datamat_4_1.mat and datamat_4_4.mat (Hauptmann
et al. 2017, doi:10.5281/zenodo.1203914). Prints by how much the estimates' bodies are off, and
draws docs/kit4.png; half a minute.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.ndimage import center_of_mass, label
from thesis.common import bare, save

from eitbench.bench.runner import run_on_measurements
from eitbench.envs.measured import MeasuredEnv, case_env

ROOT = Path(__file__).parents[1]
RADIUS = 14.0
"""cm"""
STEP = 0.1
"""cm"""


class Body(NamedTuple):
    """As a photograph of the water's surface shows it, in cm; to about 2 mm."""

    outline: np.ndarray
    conducts: bool

    @property
    def middle(self) -> np.ndarray:
        """Of its outline."""
        return self.outline.mean(axis=0)


def round_body(x: float, y: float, radius: float, conducts: bool) -> Body:
    """A ring or a disk."""
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
        off = [distance(env, estimate, body) for body in bodies]
        print(f"{name}: bodies are off by {', '.join(f'{each:.1f}' for each in off)} cm; "
              f"withheld RMSE {run.withheld_rmse:.1f} noise std", flush=True)
        draw(axes, env, estimate, bodies, name)
    shown = figure.axes[-1].collections[0]
    figure.colorbar(shown, ax=figure.axes, label="conductivity / background (decades)")
    save(figure, ROOT / "docs" / "kit4.png")


def distance(env: MeasuredEnv, estimate: np.ndarray, body: Body) -> float:
    """cm from the body to the middle of where the estimate is more than half of its extreme."""
    side = np.arange(-RADIUS, RADIUS + STEP, STEP)
    x, y = np.meshgrid(side, side)
    inside = np.hypot(x, y) < 0.99 * RADIUS
    field = np.zeros_like(x)
    points = 1e-2 * np.stack([x[inside], y[inside]], axis=1)
    field[inside] = env.task.mesh.interpolation_to(points) @ estimate
    field *= 1.0 if body.conducts else -1.0
    here = np.hypot(x - body.middle[0], y - body.middle[1]) < 2.0
    parts, _ = label(field > 0.5 * field[here].max())
    part = np.bincount(parts[here & (parts > 0)]).argmax()
    row, column = center_of_mass(parts == part)
    return float(np.hypot(side[0] + STEP * column - body.middle[0],
                          side[0] + STEP * row - body.middle[1]))


def draw(axes: Axes, env: MeasuredEnv, estimate: np.ndarray, bodies: list[Body],
         title: str) -> None:
    """The estimate, with the bodies' outlines."""
    x, y = 100.0 * env.task.mesh.points.T
    axes.tripcolor(x, y, env.task.mesh.cells, estimate, shading="gouraud", cmap="RdBu_r",
                   vmin=-1.6, vmax=1.6)
    for body in bodies:
        closed = np.vstack([body.outline, body.outline[:1]])
        axes.plot(*closed.T, color="k", linewidth=1.5)
    axes.set(title=title, xlabel="x / cm", aspect="equal")
    bare(axes)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
