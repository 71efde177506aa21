"""3D pipe (thesis 5.2): ground truth, Kalman filter and smoother."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from eitbench.data.episode_cache import truth_mesh
from eitbench.envs.estimation import EstimationEnv
from eitbench.envs.rendering import colour_range, draw_field, draw_isosurfaces

from .common import (
    agreement_line,
    draw_idle_electrodes,
    episode_error,
    format_milliseconds,
    run_baseline,
    save_figure,
)


def fig5_10(seeds: list[int], _jobs: int, out: Path) -> tuple[Path, str]:
    """Draw isosurfaces and slices of the true concentration and of both estimates."""
    env, smoothing = (EstimationEnv(f"eitbench/{name}-v0")
                      for name in ("Pipe3D", "Pipe3DSmoothing"))
    filtered = run_baseline(env, "kalman_filter", seeds[0])
    smoothed = run_baseline(smoothing, "fixed_interval_smoother", seeds[0])
    by_filter, by_smoother = episode_error(env, filtered), episode_error(smoothing, smoothed)
    constant = episode_error(env, run_baseline(env, "homogeneous", seeds[0]))
    first = env.task.warm_up + 6
    times = list(range(first, first + 20, 5))
    truth = env.truth()
    (low, high) = colour_range(env.task)
    background = env.task.expected_concentration
    lower, upper = 1.08 * background, 1.32 * background
    figure = Figure(figsize=(17.0, 4.9), dpi=120, layout="constrained")
    axes = figure.subplots(len(times), 6)
    for number, (row, t) in enumerate(zip(axes, times, strict=True), start=1):
        fields = [(truth_mesh(env.world), truth[t - 1]),
                  (env.task.mesh, filtered[t - 1].mean),
                  (env.task.mesh, smoothed[t - 1].mean)]
        for k, (mesh, values) in enumerate(fields):
            draw_isosurfaces(row[k], mesh, values, lower, upper)
            mappable = draw_field(row[3 + k], mesh, values, low, high)
            draw_idle_electrodes(row[3 + k], env.task)
            row[3 + k].set_ylabel("y / cm" if k == 0 else "")
            row[3 + k].tick_params(labelbottom=number == len(times), labelleft=k == 0)
        row[0].text(-0.02, 0.5, format_milliseconds(env, t), transform=row[0].transAxes, ha="right",
                    va="center", fontsize=10)
    for k, title in enumerate(("truth", "Kalman filter", "smoother")):
        axes[0, k].set_title(title, fontsize=11)
        axes[0, 3 + k].set_title(f"{title}, slice x = 0", fontsize=11)
        axes[-1, 3 + k].set_xlabel("z / cm")
    figure.suptitle(f"Isosurfaces of {lower:.0f} (blue) and {upper:.0f} (orange) mol/m³; fluid "
                    "flows to the right", fontsize=11)
    figure.colorbar(mappable, ax=axes, label="concentration / (mol/m³)", extend="both", aspect=40)
    path = out / "fig5.10.png"
    save_figure(figure, path)
    return path, "\n".join([
        f"ẽ_c is {by_filter:.4f} for the filter, {by_smoother:.4f} for the smoother and "
        f"{constant:.4f} for the homogeneous estimate, on {env.task.mesh.n_nodes} nodes.",
        agreement_line("both estimates locate the slugs: much better than a constant",
                       by_filter < 0.6 * constant),
        agreement_line("the smoother is better than the filter", by_smoother < by_filter),
        "Not from the thesis: inflow, electrodes and injections; it gives the figure only."])
