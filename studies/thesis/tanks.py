"""Figures 7.2 to 7.4 of the thesis: a resistive disc in a stirred tank, and two cylinders in a
stationary tank."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from eitbench.data.episode_cache import truth_mesh
from eitbench.envs.estimation import EstimationEnv
from eitbench.envs.rendering import draw_field
from eitbench.estimation import CalibrationFrame
from eitbench.numerics.fem import mass_matrix
from eitbench.numerics.mesh import Mesh
from eitbench.scoring import deficit_centroid
from eitbench.worlds.random_streams import episode_streams
from eitbench.worlds.task import Estimate, Task
from eitbench.worlds.world import World

from .common import (
    ACCENT,
    GREY,
    INK,
    agreement_line,
    despine,
    draw_flow,
    draw_idle_electrodes,
    episode_error,
    run_baseline,
    save_figure,
)

SNAPSHOTS = range(4, 41, 4)
"""States of Fig. 7.3 [T]."""


def _stirred() -> EstimationEnv:
    return EstimationEnv("eitbench/RotatingTank2D-v0")


def _at_rest() -> EstimationEnv:
    return EstimationEnv("eitbench/StationaryTank2D-v0")


def _picture(ax: Axes, task: Task, mesh: Mesh, values: np.ndarray, scale: tuple[float, float],
             circles: Sequence[tuple[np.ndarray, float]], title: str):
    """Draw a field in the round tank, with true outlines as (centre, radius) in m; return the
    mappable."""
    mappable = draw_field(ax, mesh, values, *scale)
    for centre, radius in circles:
        ax.add_patch(Circle((100 * centre[0], 100 * centre[1]), 100 * radius, fill=False,
                            edgecolor="white", linewidth=1.2, linestyle="--"))
    draw_idle_electrodes(ax, task)
    ax.set(xlim=(-14.8, 14.8), ylim=(-14.8, 14.8), xticks=(-10, 0, 10), yticks=(-10, 0, 10),
           xlabel="x / cm")
    ax.spines[:].set_visible(False)
    ax.set_title(title, fontsize=10)
    ax.label_outer(remove_inner_ticks=True)
    return mappable


# -- the stirred tank ------------------------------------------------------------------------------


def fig7_2(_seeds: list[int], _jobs: int, out: Path) -> tuple[Path, str]:
    """Draw the mesh with its electrodes, and the velocity field."""
    env = _stirred()
    world = env.world
    mesh = env.task.observation.cem.mesh
    flow = world.flow.nominal(world, fine=True)
    radius = world.vessel.radius
    figure = Figure(figsize=(10.4, 4.6), dpi=130, layout="constrained")
    left, right = figure.subplots(1, 2)
    left.triplot(100 * mesh.points[:, 0], 100 * mesh.points[:, 1], mesh.cells, color="0.45",
                 linewidth=0.35)
    _number_electrodes(left, world)
    left.set_title(f"finite elements: {mesh.n_nodes} nodes, {len(mesh.cells)} triangles",
                   fontsize=10)
    fine = flow.mesh
    velocity = flow(fine.points)
    speed = np.hypot(*velocity.T)
    mappable = draw_flow(right, fine, flow, lambda points: np.hypot(*points.T) < 0.995 * radius,
                         speed.max())
    right.set_title("velocity field", fontsize=10)
    figure.colorbar(mappable, ax=right, label="speed / (cm/s)")
    for ax in (left, right):
        draw_idle_electrodes(ax, env.task, 4)
        ax.set(aspect="equal", xlim=(-16.5, 16.5), ylim=(-16.5, 16.5), xlabel="x / cm",
               ylabel="y / cm")
    path = out / "fig7.2.png"
    save_figure(figure, path)
    turning = fine.points[:, 0] * velocity[:, 1] - fine.points[:, 1] * velocity[:, 0]
    weights = mass_matrix(fine).sum(axis=1)
    mean, r = weights @ speed / weights.sum(), np.hypot(*fine.points.T)
    ring = np.abs(r - 0.5 * radius) < 0.05 * radius
    turn = 2 * np.pi / np.mean(turning[ring] / r[ring]**2)
    return path, "\n".join([
        f"The speed is up to {100 * speed.max():.1f} cm/s, {100 * mean:.1f} cm/s on average; "
        f"halfway to the wall a revolution takes {turn:.2f} s or {turn / world.time_step:.0f} "
        "injections.",
        agreement_line("the liquid rotates in one direction nearly everywhere",
                       bool(weights[turning > 0].sum() > 0.95 * weights.sum())),
        "Not from the thesis, which has no numbers: size, speed and position of the stirrer."])


def _number_electrodes(ax: Axes, world: World) -> None:
    """Write the number of each electrode; the pair that injects is bold red."""
    current = world.currents[0]
    for k, angle in enumerate(world.vessel.electrode_spans.mean(axis=1)):
        x, y = 108 * world.vessel.radius * np.array([np.cos(angle), np.sin(angle)])
        ax.text(x, y, str(k), ha="center", va="center", fontsize=8,
                color=ACCENT if current[k] else "0.3",
                fontweight="bold" if current[k] else "normal")


def fig7_3(seeds: list[int], _jobs: int, out: Path) -> tuple[Path, str]:
    """Draw the resistive disc, the Kalman filter's estimates, and the errors of its position."""
    env = _stirred()
    world = env.world
    disc = world.target
    filtered = run_baseline(env, "kalman_filter", seeds[0])
    stationary = run_baseline(env, "gauss_newton", seeds[0])
    constant = run_baseline(env, "homogeneous", seeds[0])
    path = out / "fig7.3.png"
    centres = disc.path(world, episode_streams(seeds[0]).flow).centres[1:]
    distances = [_distances(env, estimates, centres) for estimates in (filtered, stationary)]
    _disc_figure(path, env, filtered, centres, distances)
    by_filter, by_stationary, by_constant = (episode_error(env, each)
                                             for each in (filtered, stationary, constant))
    error, stationary_error = (float(np.median(each[env.task.warm_up:])) for each in distances)
    return path, "\n".join([
        f"After t = {env.task.warm_up} the median position error of the filter is "
        f"{100 * error:.1f} cm (90 % of errors are below "
        f"{100 * np.quantile(distances[0][env.task.warm_up:], 0.9):.1f} cm), of a stationary image "
        f"{100 * stationary_error:.1f} cm; the radius of the disc is {100 * disc.radius:.1f} cm. "
        f"ẽ_c is {by_filter:.4f}, {by_stationary:.4f}, and {by_constant:.4f} for the homogeneous "
        "estimate.",
        agreement_line("the median position error of the filter is less than the radius",
                       error < disc.radius),
        agreement_line("a stationary image of the one pair has at least three times that error",
                       stationary_error > 3 * error),
        agreement_line("by ẽ_c the filter is far better than a constant, and a stationary image is "
                       "not", by_filter < 0.75 * by_constant < 0.75 / 0.95 * by_stationary),
        "Not from the thesis: disc, flow and times. The disc is nearly insulating, and the model "
        "does not contain it."])


def _distances(env: EstimationEnv, estimates: list[Estimate], centres: np.ndarray) -> np.ndarray:
    """Return the distances (T,) in m of the estimated from the true centre of the disc."""
    mesh = env.task.mesh
    weights = mass_matrix(mesh).sum(axis=1)
    estimated = np.array([deficit_centroid(estimate.mean, mesh.points, weights)
                       for estimate in estimates])
    return np.hypot(*(estimated - centres).T)


def _disc_figure(path: Path, env: EstimationEnv, filtered: list[Estimate],
                 centres: np.ndarray, distances: list[np.ndarray]) -> None:
    world = env.world
    half = len(SNAPSHOTS) // 2
    radius = world.target.radius
    figure = Figure(figsize=(11.6, 12.6), dpi=110, layout="constrained")
    top, bottom = np.asarray(figure.subfigures(2, 1, height_ratios=(4.2, 1.1)))
    axes = top.subplots(4, half, sharex=True, sharey=True)
    truth = env.truth()
    scale = 0.0, 1.4 * world.expected_concentration
    for k, t in enumerate(SNAPSHOTS):
        pair = axes[2 * (k // half):2 * (k // half) + 2, k % half]
        disc = [(centres[t - 1], radius)]
        _picture(pair[0], env.task, truth_mesh(env.world), truth[t - 1],
                 scale, disc, f"truth, t = {t}")
        mappable = _picture(pair[1], env.task, env.task.mesh, filtered[t - 1].mean, scale, disc,
                            f"filter, t = {t}")
    top.colorbar(mappable, ax=axes, label="concentration / (mol/m³)", extend="both", aspect=50,
                 shrink=0.8)
    ax = bottom.subplots()
    times = np.arange(1, len(centres) + 1)
    for distance, colour, label in zip(distances, (INK, ACCENT),
                                       ("Kalman filter", "stationary Gauss–Newton"), strict=True):
        ax.plot(times, 100 * distance, color=colour, label=label, linewidth=1.4)
    ax.axhline(100 * radius, color=GREY, linestyle="--", linewidth=1, label="radius of the disc")
    ax.axvspan(0, env.task.warm_up + 0.5, color="0.93", zorder=0, label="not scored")
    ax.set(xlabel=f"injection t (one every {1e3 * world.time_step:.0f} ms)",
           ylabel="position error / cm", xlim=(0, times[-1]), ylim=(0, None))
    ax.legend(frameon=False, ncols=4, fontsize=9, loc="upper center", bbox_to_anchor=(0.5, 1.2))
    despine(ax)
    save_figure(figure, path)


# -- the stationary tank ---------------------------------------------------------------------------


def fig7_4(seeds: list[int], _jobs: int, out: Path) -> tuple[Path, str]:
    """Draw the target, the Kalman filter's estimates after 1 … 5 injections and a frame, and the
    Gauss–Newton estimate."""
    env = _at_rest()
    world = env.world
    metal = world.target.concentration_ratio
    frame = len(env.task.currents)
    filtered = [estimate.mean for estimate in run_baseline(env, "kalman_filter", seeds[0])]
    fitted = run_baseline(env, "map_estimate", seeds[0])[frame - 1].mean
    cylinders = world.target.draw(world, episode_streams(seeds[0]).flow)
    truth = env.truth()[0]
    scale = 0.5 * world.background, float(np.ceil(max(filtered[frame - 1].max(), fitted.max()) / 10)
                                          * 10)
    figure = Figure(figsize=(12.4, 6.2), dpi=130, layout="constrained")
    axes = figure.subplots(2, 4, sharex=True, sharey=True)
    _picture(axes[0, 0], env.task, truth_mesh(env.world), truth, scale,
             (), "target")
    panels = [(filtered[k - 1], f"filter after {k} injection{'s' * (k > 1)}")
              for k in (1, 2, 3, 4, 5, frame)]
    for ax, (values, title) in zip(axes.flat[1:],
                                   [*panels, (fitted, f"Gauss–Newton after {frame}")], strict=True):
        mappable = _picture(ax, env.task, env.task.mesh, values, scale, cylinders, title)
    figure.colorbar(mappable, ax=axes, label="concentration / (mol/m³)", extend="both", aspect=40)
    path = out / "fig7.4.png"
    save_figure(figure, path)
    located = [_both_located(env.task.mesh, mean, cylinders) for mean in filtered]
    weights = mass_matrix(env.task.mesh).sum(axis=1)
    initial = _initial_estimate(env, seeds[0])
    early, late = (np.sqrt(weights @ change**2)
                   for change in (filtered[4] - initial, filtered[frame - 1] - filtered[4]))
    first = next((k for k in range(1, len(located) + 1) if all(located[k - 1:])), None)
    return path, "\n".join([
        f"Both cylinders are {f'located from injection {first} on' if first else 'not located'}. "
        f"From injection 5 to {frame} the estimate changes {late / early:.2f} times as much as "
        "from 0 to 5.",
        agreement_line("after five injections both cylinders are located", located[4]),
        agreement_line("after five injections the estimate changes by less than a quarter",
                       bool(late < 0.25 * early)),
        "Not from the thesis: size and position of the cylinders, and the order of injections. "
        f"The cylinders conduct {metal:g} times as well as the saline "
        f"({metal * world.background:.0f} mol/m³, beyond the colour scale)."])


def _initial_estimate(env: EstimationEnv, seed: int) -> float:
    """Return ĉ_bh of the first injection in mol/m³, the filter's estimate at t = 0."""
    observation, _ = env.reset(seed=seed)
    first = CalibrationFrame(env.task)
    first.add(observation["voltages"], observation["currents"])
    return first.c_ref


def _both_located(mesh: Mesh, values: np.ndarray,
                  cylinders: Sequence[tuple[np.ndarray, float]]) -> bool:
    """Return True if each cylinder contains, within 1 cm, one of the two highest local maxima."""
    highest = values.copy()
    for corner in mesh.cells.T:
        np.maximum.at(highest, corner, values[mesh.cells].max(axis=1))
    peaks = np.flatnonzero(values >= highest)
    peaks = peaks[np.argsort(values[peaks])[::-1][:2]]
    near = np.array([[np.hypot(*(mesh.points[peak] - centre)) < radius + 0.01
                      for centre, radius in cylinders] for peak in peaks])
    return near.shape == (2, 2) and bool((near[0, 0] and near[1, 1]) or (near[0, 1] and near[1, 0]))
