"""Figures 5.4 to 5.8 of the thesis: the 2D pipe with the true flow and with a wrong velocity."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from threadpoolctl import threadpool_limits

from eitbench import scoring
from eitbench.bench.methods import load_method
from eitbench.bench.runner import run_estimator
from eitbench.bench.scores import compute_scores
from eitbench.data.episode_cache import score_operators, truth_mesh
from eitbench.envs.estimation import EstimationEnv
from eitbench.envs.rendering import STD_COLORMAP, colour_range, draw_field

from .common import (
    agreement_line,
    despine,
    draw_comparison,
    draw_idle_electrodes,
    episode_error,
    format_milliseconds,
    make_pipe_grid,
    run_baseline,
    run_parallel,
    save_figure,
    snapshot_times,
)

VELOCITIES = np.arange(0.0, 9.01, 0.5)
"""Assumed mean velocities in m/s of Fig. 5.8."""


def _env(lag: int | str = 0, mean_velocity: float | None = None) -> EstimationEnv:
    assume = {} if mean_velocity is None else {"mean_velocity": mean_velocity}
    return EstimationEnv("eitbench/Pipe2D-v0", lag=lag, assume=assume)


def fig5_4(seeds: list[int], _jobs: int, out: Path) -> tuple[Path, str]:
    """Draw the true concentration, and the Kalman filter and fixed-interval smoother estimates."""
    filter_env, smoothing_env = _env(), _env("all")
    filtered = run_baseline(filter_env, "kalman_filter", seeds[0])
    smoothed = run_baseline(smoothing_env, "fixed_interval_smoother", seeds[0])
    path = out / "fig5.4.png"
    draw_comparison(path, filter_env,
                    {"Kalman filter": filtered, "fixed-interval smoother": smoothed})
    by_filter = episode_error(filter_env, filtered)
    by_smoother = episode_error(smoothing_env, smoothed)
    return path, "\n".join([
        f"ẽ_c is {by_filter:.4f} for the filter and {by_smoother:.4f} for the smoother.",
        agreement_line("the smoother is better than the filter", by_smoother < by_filter),
        "Not from the thesis: inflow, electrodes and injections, so slugs have other positions."])


def fig5_5(seeds: list[int], _jobs: int, out: Path) -> tuple[Path, str]:
    """Draw the variances of the estimation error of filter and smoother."""
    env = _env()
    filtered = run_baseline(env, "kalman_filter", seeds[0])
    smoothed = run_baseline(_env("all"), "fixed_interval_smoother", seeds[0])
    t = snapshot_times(env)[-1]
    figure = Figure(figsize=(11.0, 2.4), dpi=130, layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    variances = [estimates[t - 1].variance for estimates in (filtered, smoothed)]
    top = float(np.quantile(np.asarray(variances[0]), 0.995))
    for ax, variance, title in zip(axes, variances, ("Kalman filter", "fixed-interval smoother"),
                                   strict=True):
        mappable = draw_field(ax, env.task.mesh, np.asarray(variance), 0.0, top, STD_COLORMAP)
        draw_idle_electrodes(ax, env.task)
        ax.set(title=f"{title}, {format_milliseconds(env, t)}", xlabel="x / cm")
    figure.colorbar(mappable, ax=axes, label="variance / (mol/m³)²", extend="max")
    path = out / "fig5.5.png"
    save_figure(figure, path)
    by_filter, by_smoother = (np.asarray(variance) for variance in variances)
    x = env.task.mesh.points[:, 0]
    third = np.ptp(env.task.mesh.points[:, 0]) / 3
    along = [by_filter[(x >= k * third) & (x <= (k + 1) * third)].mean() for k in range(3)]
    return path, "\n".join([
        f"Mean variance {by_filter.mean():.2f} (mol/m³)² for the filter, {by_smoother.mean():.2f} "
        "for the smoother.",
        agreement_line("the variance is largest at the inlet, where uncertainty enters, and "
                       "decreases along the flow",
                       bool(along[0] > along[1] > along[2] and x[by_filter.argmax()] < third)),
        agreement_line("the variance of the smoother is smaller everywhere",
                       bool((by_smoother <= by_filter + 1e-9).all())),
        "Not from the thesis: inflow noise and electrodes, which determine the scale."])


def fig5_6(seeds: list[int], _jobs: int, out: Path) -> tuple[Path, str]:
    """Draw stationary reconstructions of four frames of the moving target."""
    env = _env("all")
    images = run_baseline(env, "gauss_newton", seeds[0])
    frame = len(env.task.currents)
    truth = env.truth()
    starts = [frame * k for k in range(1, 5)]
    figure, axes = make_pipe_grid(len(starts), 2,
                                  ["true average over the frame", "stationary Gauss–Newton"])
    low, high = colour_range(env.task)
    averages = []
    for row, start in zip(axes, starts, strict=True):
        averages.append(truth[start:start + frame].mean(axis=0))
        draw_field(row[0], truth_mesh(env.world), averages[-1], low, high)
        mappable = draw_field(row[1], env.task.mesh, images[start].mean, low, high)
        for ax in row:
            draw_idle_electrodes(ax, env.task)
            ax.label_outer()
        row[0].set_ylabel(f"until {format_milliseconds(env, start + frame)}\ny / cm", fontsize=9)
    figure.colorbar(mappable, ax=axes, label="concentration / (mol/m³)", extend="both", aspect=40)
    path = out / "fig5.6.png"
    save_figure(figure, path)
    interpolation, mass = score_operators(env.world)
    average_error = scoring.relative_error(
        np.array([interpolation @ images[t].mean for t in starts]), np.array(averages), mass)
    error = episode_error(env, images)
    constant = episode_error(env, run_baseline(env, "homogeneous", seeds[0]))
    return path, "\n".join([
        f"ẽ_c is {error:.4f}, and {constant:.4f} for the homogeneous estimate; relative to the "
        f"true average over the frame the error of an image is {average_error:.4f}.",
        agreement_line("the images are worse than a constant", error > constant),
        agreement_line("they are not temporal averages of the target either",
                       average_error > 0.5 * error),
        "Not from the thesis: the order of injections, which determines the artefacts."])


def fig5_7(seeds: list[int], _jobs: int, out: Path) -> tuple[Path, str]:
    """Draw Kalman filter estimates for assumed mean velocities of 200 and 700 cm/s; the true one is
    450 cm/s."""
    columns = {}
    errors = []
    for velocity in (2.0, 7.0):
        env = _env(mean_velocity=velocity)
        estimates = run_baseline(env, "kalman_filter", seeds[0])
        columns[f"filter, assumed {100 * velocity:.0f} cm/s"] = estimates
        errors.append(episode_error(env, estimates))
    right = _env()
    error = episode_error(right, run_baseline(right, "kalman_filter", seeds[0]))
    path = out / "fig5.7.png"
    draw_comparison(path, env, columns)
    constant = episode_error(right, run_baseline(right, "homogeneous", seeds[0]))
    return path, "\n".join([
        f"ẽ_c is {errors[0]:.4f} with 200 cm/s and {errors[1]:.4f} with 700 cm/s, {error:.4f} with "
        f"the true 450 cm/s and {constant:.4f} for the homogeneous estimate.",
        agreement_line("a wrong velocity costs accuracy", min(errors) > error),
        agreement_line("the estimates are still better than a constant",
                       max(errors) < constant)])


def velocity_sweep(seeds: list[int], jobs: int,
                   velocities: np.ndarray = VELOCITIES) -> dict[str, np.ndarray]:
    """Return scores (velocities, seeds) of the Kalman filter for assumed mean velocities in m/s:
    ``error``, ``voltage_discrepancy`` (V²) and ``nis``."""
    rows = run_parallel(_filter_scores, [(velocity, seeds) for velocity in velocities], jobs,
                        "sweeping the velocity")
    return {key: np.array([[scores[key] for scores in row] for row in rows])
            for key in ("error", "voltage_discrepancy", "nis")}


def _filter_scores(velocity: float, seeds: list[int]) -> list[dict[str, float]]:
    env = _env(mean_velocity=float(velocity))
    with threadpool_limits(1):
        kalman_filter = load_method("kalman_filter", "estimation")
        return [compute_scores("estimation", run_estimator(env, kalman_filter, seed).outcome)
                for seed in seeds]


def fig5_8(seeds: list[int], jobs: int, out: Path) -> tuple[Path, str]:
    """Draw estimation error, voltage discrepancy and NIS over the assumed mean velocity."""
    sweep = velocity_sweep(seeds, jobs)
    figure = Figure(figsize=(11.0, 3.6), dpi=130, layout="constrained")
    panels: list[tuple[str, float, str]] = [("error", 1.0, "ẽ_c"),
                                            ("voltage_discrepancy", 1e6, "ẽ_V / mV²"),
                                            ("nis", 1.0, "NIS/m")]
    best = {}
    for ax, (key, unit, label) in zip(figure.subplots(1, 3), panels, strict=True):
        mean = unit * sweep[key].mean(axis=1)
        best[key] = 100 * VELOCITIES[mean.argmin()]
        _sweep_panel(ax, mean, label)
    path = out / "fig5.8.png"
    save_figure(figure, path)
    return path, "\n".join([
        f"Minimum at {best['error']:.0f} cm/s for ẽ_c, {best['voltage_discrepancy']:.0f} for ẽ_V, "
        f"{best['nis']:.0f} for NIS, over {len(seeds)} episodes; the truth is 450.",
        agreement_line("the error is smallest near the true velocity", 400 <= best["error"] <= 500),
        agreement_line("the voltages alone indicate the velocity roughly (500 in the thesis)",
                       400 <= best["voltage_discrepancy"] <= 550),
        "Not from the thesis: NIS, the innovations relative to their predicted covariance."])


def _sweep_panel(ax: Axes, mean: np.ndarray, label: str) -> None:
    ax.plot(100 * VELOCITIES, mean, "o-", color="#0b6e75", markersize=4)
    ax.axvline(450, color="0.6", linestyle="--", linewidth=1)
    ax.set(xlabel="assumed mean velocity / (cm/s)", ylabel=label, ylim=(0.0, 1.08 * mean.max()))
    ax.text(460, 1.06 * mean.max(), "true", color="0.4", va="top", fontsize=9)
    despine(ax)
