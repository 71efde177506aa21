"""Pipe past an obstacle, a next step of the thesis: cost of a simplified flow model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from eitbench.data.episode_cache import truth_mesh
from eitbench.envs.estimation import EstimationEnv
from eitbench.numerics.fem import mass_matrix
from eitbench.physics.transport import VelocityField
from eitbench.worlds.world import World

from .common import (
    agreement_line,
    draw_fields,
    draw_flow,
    draw_idle_electrodes,
    episode_error,
    run_baseline,
    save_figure,
    snapshot_times,
)


def _env(flow: str) -> EstimationEnv:
    """Return the environment whose estimators assume this flow."""
    return EstimationEnv("eitbench/Pipe2DObstacle-v0", assume={"flow": flow})


def obstacle(seeds: list[int], _jobs: int, out: Path) -> tuple[Path, str]:
    """Draw the true and the assumed flow, and the Kalman filter with each of them."""
    columns = []
    errors = []
    for flow in ("parabolic", "real"):
        env = _env(flow)
        columns.append(run_baseline(env, "kalman_filter", seeds[0]))
        errors.append(episode_error(env, columns[-1]))
    constant = episode_error(env, run_baseline(env, "homogeneous", seeds[0]))
    times = snapshot_times(env, 4)
    figure = Figure(figsize=(11.4, 7.0), dpi=130, layout="constrained")
    top, bottom = np.asarray(figure.subfigures(2, 1, height_ratios=(1.0, 2.3)))
    backwards = _draw_flows(top.subplots(1, 2, sharey=True), top, env, env.world)
    axes = bottom.subplots(len(times), 3, sharex=True, sharey=True)
    mappable = draw_fields(env, axes, times, columns)
    titles = ("truth", f"filter with the parabola, ẽ$_c$ = {errors[0]:.4f}",
              f"filter with the true flow, ẽ$_c$ = {errors[1]:.4f}")
    for ax, last, title in zip(axes[0], axes[-1], titles, strict=True):
        ax.set_title(title, fontsize=10)
        last.set_xlabel("x / cm")
    bottom.colorbar(mappable, ax=axes, label="concentration / (mol/m³)", extend="both", aspect=40)
    path = out / "obstacle.png"
    save_figure(figure, path)
    return path, "\n".join([
        f"ẽ_c is {errors[0]:.4f} with the parabola, {errors[1]:.4f} with the true flow and "
        f"{constant:.4f} for the homogeneous estimate. The fluid flows back in "
        f"{100 * backwards:.0f} % of the pipe.",
        agreement_line("the simple flow model gives better estimates than a constant",
                       errors[0] < constant),
        agreement_line("the true flow reduces the error", errors[1] < errors[0]),
        "Not from the thesis: the obstacle, and the eddy viscosity, which determines the length of "
        "the recirculation."])


def _draw_flows(axes: np.ndarray, figure, env: EstimationEnv, world: World) -> float:
    """Draw the true and the assumed flow; return the fraction of the pipe with reversed flow."""
    pipe = world.vessel
    mesh = truth_mesh(env.world)
    real = world.flow.nominal(world, fine=True)
    assert real is not None
    velocity = real(mesh.points)

    def inside(points: np.ndarray) -> np.ndarray:
        return points[:, 1] > pipe.bulge(points[:, 0]) - pipe.half_width

    flows: dict[str, VelocityField] = {"true flow (Navier–Stokes)": real,
                                       "assumed: a parabola at each x":
                                           world.flow.assumed_velocity(world)}
    top = max(float(np.hypot(*flow(mesh.points).T).max()) for flow in flows.values())
    for ax, (title, flow) in zip(axes, flows.items(), strict=True):
        mappable = draw_flow(ax, mesh, flow, inside, top)
        draw_idle_electrodes(ax, env.task)
        ax.set(xlim=(0, 100 * pipe.length), ylim=(-100 * pipe.half_width, 100 * pipe.half_width),
               xlabel="x / cm")
        ax.set_title(title, fontsize=10)
        ax.label_outer()
    figure.colorbar(mappable, ax=axes, label="speed / (cm/s)")
    weights = mass_matrix(mesh).sum(axis=1)
    return float(weights[velocity[:, 0] < 0].sum() / weights.sum())
