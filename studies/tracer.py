"""A tracer between boreholes: `eitbench fetch alert`, then `python studies/tracer.py`, 25 minutes.

The linearised Kalman filter with a random walk estimates the conductivity of the case `alert`. The
script prints the withheld RMSE of the filter and of the unchanged first frame, and the centroid of
the tracer in some frames, and draws docs/tracer.png.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation
from thesis.common import save_figure

from eitbench.bench.runner import run_on_measurements
from eitbench.envs.measured import MeasuredEnv, case_env
from eitbench.numerics.fem import mass_matrix
from eitbench.numerics.mesh import Mesh
from eitbench.scoring import deficit_centroid

ROOT = Path(__file__).parents[1]
FRAMES = (5, 8, 11, 14, 17, 20)
"""Frames of the figure, from 1; later the estimates have artefacts as large as the tracer."""
LIMITS = 0.3, 3.0
"""Colour scale of the conductivity relative to the background, logarithmic."""


def main() -> None:
    env = case_env("alert")
    K = env.measurements.frame_length
    kept = {K * frame for frame in FRAMES}
    run = run_on_measurements(env, "kalman_filter", kept=kept)
    print(f"withheld RMSE: {run.withheld_rmse:.1f} (filter), {unchanged_rmse(env):.1f} (unchanged "
          "first frame) noise std")
    draw(env.task.mesh, run.mean / env.task.expected_concentration)


def unchanged_rmse(env: MeasuredEnv) -> float:
    """Return the withheld RMSE, relative to the noise, if the first frame predicts all others."""
    frames = env.measurements.frames(env.episode_steps)
    residuals = (frames[1:] - frames[0]) / env.task.noise.std(np.nan_to_num(frames[1:]))
    return float(np.sqrt(np.nanmean(residuals[:, env.withheld_mask]**2)))


def draw(mesh: Mesh, relative: np.ndarray) -> None:
    """Draw the conductivities (frames, n) relative to the background, and print centroids."""
    figure = Figure(figsize=(10.5, 3.6), dpi=110, layout="constrained")
    panels = figure.subplots(2, 3, sharex=True, sharey=True)
    areas = mass_matrix(mesh).sum(axis=0)
    shape = Triangulation(*mesh.points.T, mesh.cells)
    for axes, frame, values in zip(panels.flat, FRAMES, relative, strict=True):
        x, y = deficit_centroid(-values, mesh.points, areas)
        print(f"frame {frame}: tracer at {x:.2f} m, {-y:.2f} m deep", flush=True)
        drawn = axes.tripcolor(shape, np.log(np.clip(values, *LIMITS)), shading="gouraud",
                               vmin=np.log(LIMITS[0]), vmax=np.log(LIMITS[1]))
        axes.plot(x, y, "+", color="white")
        axes.set(title=f"frame {frame}", aspect="equal")
    for axes in panels[-1]:
        axes.set_xlabel("position / m")
    for axes in panels[:, 0]:
        axes.set_ylabel("height / m")
    bar = figure.colorbar(drawn, ax=panels, label="conductivity / background")
    ticks = np.array([0.3, 0.5, 1.0, 2.0, 3.0])
    bar.set_ticks(np.log(ticks), labels=[f"{tick:g}" for tick in ticks])
    save_figure(figure, ROOT / "docs" / "tracer.png")


if __name__ == "__main__":
    main()
