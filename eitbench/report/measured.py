"""HTML page of a run on measurements."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import FuncFormatter

from eitbench._files import write_atomically
from eitbench.bench.measured import N_PLOTTED_FRAMES, MeasuredRun
from eitbench.envs.measured import MeasuredEnv
from eitbench.envs.rendering import draw_electrodes, draw_field
from eitbench.measured.calibration import electrode_misfits
from eitbench.measured.quality import percent
from eitbench.measured.segmentation import ktc_score, require_round_tank, segment
from eitbench.report.templates import data_uri, figure_image, render_template

CLASS_COLOURS = ListedColormap(["#f4f4f2", "#d1495b", "#0b6e75"])
"""Water, resistive, conductive."""
LINE_COLOURS = ("#0b6e75", "#d1495b", "#b8860b", "#7a5195", "#5b6770")
CORRECTION_TEXT = {"offset": "The misfit is subtracted from all measurements.",
                   "gain": "Each measurement is divided by its ratio to the model.",
                   "none": "Nothing is corrected: the image is absolute."}
MIN_PLOTTED = 1e-2
"""Lower end of the axes of residuals and NIS, which are 0 in a homogeneous first frame."""
LOG_SCALE_RATIO = 5.0
"""Ratio of the largest to the smallest estimate from which on colours are logarithmic."""
COLOUR_QUANTILES = (0.005, 0.995)
MIN_COLOUR_RANGE = 0.02
"""Smallest range of the colours relative to the mean conductivity; noise would fill a smaller."""


def write_report(path: Path, env: MeasuredEnv, runs: Sequence[MeasuredRun],
                 truth: np.ndarray | None = None) -> None:
    """Write a page with the estimates of the first run, the residuals and NIS of all, calibration,
    data-quality warnings, residuals by electrode, and, with a ``truth`` (256, 256) for
    `eitbench.measured.segmentation`, the segmentations."""
    source = dict(env.measurements.source)
    figures = {"fit": _fit(env), "contacts": _contacts(env), "electrodes": _electrodes(runs[0]),
               "over_time": _residuals_over_time(env, runs), "velocity": _velocity(env, runs),
               "segmentation": None if truth is None else _segmentations(env, runs, truth)}
    page = render_template(
        "measured.html.j2", root="", title=str(source.pop("file", "Measurements")), source=source,
        env=env, runs=runs, percent=percent, estimate=_estimate(env, runs[0]),
        correction=CORRECTION_TEXT[env.calibration.correction],
        **{name: data_uri(figure_image(figure)) if figure else ""
           for name, figure in figures.items()})
    write_atomically(path, page)


def _estimate(env: MeasuredEnv, run: MeasuredRun) -> str:
    """Return the last estimate of a target at rest, or an animation, as a data URI."""
    if env.task.is_stationary:
        return data_uri(figure_image(_picture(env, run, len(run.steps) - 1)))
    after = np.flatnonzero(run.steps > min(env.task.warm_up, env.episode_steps - 1))
    rows = after[np.unique(np.linspace(0, len(after) - 1, N_PLOTTED_FRAMES).round().astype(int))]
    frames = [figure_image(_picture(env, run, int(row))) for row in rows]
    return data_uri(frames[0], "webp", save_all=True, append_images=frames[1:], loop=0,
                    duration=125, quality=40, method=4)


def _picture(env: MeasuredEnv, run: MeasuredRun, row: int) -> Figure:
    """Estimate and standard deviation in a row of the run."""
    task, t = env.task, int(run.steps[row])
    scale = 1e3 * env.calibration.conductivity / task.expected_concentration
    shown = scale * run.mean[run.steps > min(task.warm_up, env.episode_steps - 1)]
    low, high = np.quantile(shown, COLOUR_QUANTILES)
    wider = max(0.5 * (MIN_COLOUR_RANGE * abs(low + high) / 2 - (high - low)), 0.0)
    low, high = low - wider, high + wider
    field = scale * run.mean[row]
    in_decades = shown.min() > 0.0 and high > LOG_SCALE_RATIO * low
    if in_decades:
        field, low, high = (np.log10(each) for each in (field, low, high))
    panels: list[tuple[np.ndarray, float, float, str, str]] = [
        (field, low, max(high, low + 1e-12), "viridis", "conductivity / (mS/m)")]
    if run.variance is not None and np.isfinite(run.variance[row]).all():
        spread = scale * np.sqrt(run.variance[row])
        panels.append((spread, 0.0, float(spread.max()), "magma", "standard deviation / (mS/m)"))
    figure, axes = _panels(len(panels), (5.2 * len(panels), 4.4))
    current = env.measurements.currents[env.measurements.injection_index[t - 1]]
    for ax, (values, least, most, colours, label) in zip(axes, panels, strict=True):
        mappable = draw_field(ax, task.mesh, values, least, most, colours)
        draw_electrodes(ax, task, current, width=4.0)
        ax.set(xlabel="x / cm")
        bar = figure.colorbar(mappable, ax=ax, label=label, shrink=0.85)
        if in_decades and ax is axes[0]:
            bar.ax.yaxis.set_major_formatter(_POWERS)
    figure.suptitle(f"{run.method}, {env.measurements.times[t - 1]:.4g} s", fontsize=11)
    return figure


def _segmentations(env: MeasuredEnv, runs: Sequence[MeasuredRun], truth: np.ndarray) -> Figure:
    """Segmentation of the truth, and of each method's last estimate."""
    side = 100 * require_round_tank(env.vessel).radius
    pictures = {"truth": truth}
    for run in runs:
        found = segment(env.vessel, env.task, run.mean[-1])
        pictures[f"{run.method}: {ktc_score(truth, found):.2f}"] = found
    figure, axes = _panels(len(pictures), (3.0 * len(pictures), 3.3))
    for ax, (title, picture) in zip(axes, pictures.items(), strict=True):
        ax.imshow(picture, cmap=CLASS_COLOURS, vmin=0, vmax=2, extent=(-side, side, -side, side),
                  interpolation="nearest")
        ax.add_patch(Circle((0.0, 0.0), side, fill=False, color="0.4"))
        ax.set(title=title, xlabel="x / cm")
    return figure


def _residuals_over_time(env: MeasuredEnv, runs: Sequence[MeasuredRun]) -> Figure | None:
    """Draw withheld residuals and NIS of each method, averaged over a warm-up."""
    residuals, nis = (
        pd.DataFrame(each).rolling(max(env.task.warm_up, 1), center=True, min_periods=1).mean()
        for each in ({run.method: run.withheld_residual_rms**2 for run in runs},
                     {run.method: run.nis for run in runs}))
    figure = _curves(env, {"withheld residual / noise std": residuals**0.5, "NIS/m": nis}, 3.4)
    for ax in figure.axes if figure else ():
        ax.axhline(1.0, color="0.7", linewidth=1)
        ax.set_yscale("log")
        ax.set_ylim(bottom=max(ax.get_ylim()[0], MIN_PLOTTED))
    return figure


def _velocity(env: MeasuredEnv, runs: Sequence[MeasuredRun]) -> Figure | None:
    """Draw the velocity estimates of each method."""
    velocity = {run.method: run.velocity[:, 0] for run in runs if run.velocity is not None}
    return _curves(env, {"mean velocity / (m/s)": pd.DataFrame(velocity)}, 2.8)


def _curves(env: MeasuredEnv, panels: dict[str, pd.DataFrame], height: float) -> Figure | None:
    """Draw a column (T,) for each method over time, in a panel for each label -> curves; None
    without data."""
    shown = {label: each for label, each in panels.items() if each.notna().to_numpy().any()}
    if not shown:
        return None
    figure, axes = _panels(len(shown), (10.5, height))
    for ax, (label, curves) in zip(axes, shown.items(), strict=True):
        for (method, values), colour in zip(curves.items(), cycle(LINE_COLOURS), strict=False):
            ax.plot(env.measurements.times, values, color=colour, label=method)
        ax.set(xlabel="time / s", ylabel=label)
    axes[0].legend(frameon=False, fontsize=9)
    return figure


def _fit(env: MeasuredEnv) -> Figure:
    """Draw measurements of homogeneous fluid over the fitted model's voltages."""
    figure, (values, misfit) = _panels(2, (10.5, 3.6))
    known = np.isfinite(env.calibration.mean_voltages)
    measured = 1e3 * env.calibration.mean_voltages[known]
    computed = 1e3 * env.calibration.model_voltages[known]
    ends = [measured.min(), measured.max()]
    values.plot(ends, ends, color="0.8", linewidth=1)
    values.plot(computed, measured, ".", color=LINE_COLOURS[0], markersize=3)
    values.set(xlabel="model / mV", ylabel="measured / mV")
    misfit.plot(computed, measured - computed, ".", color=LINE_COLOURS[1], markersize=3)
    misfit.axhline(0.0, color="0.8", linewidth=1)
    misfit.set(xlabel="model / mV", ylabel="measured − model / mV")
    return figure


def _contacts(env: MeasuredEnv) -> Figure:
    """Contact impedances with their uncertainty, and the misfit of each electrode's readings."""
    calibration = env.calibration
    figure, (impedance, misfit) = _panels(2, (10.5, 3.2))
    z = 1e3 * calibration.contact_impedance
    number, factor = np.arange(1, len(z) + 1), np.exp(calibration.contact_impedance_std)
    impedance.errorbar(number, z, [z - z / factor, z * factor - z], fmt="o", color=LINE_COLOURS[0],
                       markersize=4, linewidth=1)
    impedance.set(xlabel="electrode", ylabel="contact impedance / (mΩ·m²)", yscale="log")
    misfits = electrode_misfits(calibration, env.measurements.matrix)
    misfits *= 100 / np.nanmean(np.abs(calibration.mean_voltages))
    misfit.bar(number, misfits, color=LINE_COLOURS[1])
    misfit.set(xlabel="electrode", ylabel="misfit of its measurements / %\nof the mean measurement")
    return figure


def _electrodes(run: MeasuredRun) -> Figure:
    """Residuals of each electrode's readings over time; bars for a single frame."""
    residuals = run.electrode_residual_rms
    number = np.arange(1, residuals.shape[1] + 1)
    figure, (axes,) = _panels(1, (10.5, 1.6 + 0.09 * len(number)))
    if len(residuals) == 1:
        axes.bar(number, residuals[0], color=LINE_COLOURS[1])
        axes.set(xlabel="electrode", ylabel="residual / noise std",
                 ylim=(0.0, max(1.0, 1.05 * float(np.nanmax(residuals)))))
        return figure
    shown = np.log10(np.maximum(residuals.T, 1e-3))
    drawn = axes.pcolormesh(run.frame_times, number, shown, cmap="magma", shading="nearest",
                            vmin=0.0, vmax=max(1.0, float(np.nanmax(shown))))
    axes.set(xlabel="time / s", ylabel="electrode")
    axes.invert_yaxis()
    bar = figure.colorbar(drawn, ax=axes, label="residual / noise std")
    bar.ax.yaxis.set_major_formatter(_POWERS)
    return figure


_POWERS = FuncFormatter(lambda value, _: f"{10**value:.3g}")


def _panels(count: int, size: tuple[float, float]) -> tuple[Figure, Sequence[Axes]]:
    """Return a figure of this size in inches, and its axes side by side."""
    figure = Figure(figsize=size, dpi=100, layout="constrained")
    axes = figure.subplots(1, count, squeeze=False)[0]
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
    return figure, axes
