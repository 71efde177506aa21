"""What methods make of a record of a real instrument, as a page."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import FuncFormatter
from PIL import Image

from eitbench._files import write_atomically
from eitbench.bench.measured import electrode_misfits
from eitbench.bench.segmentation import check_tank, ktc_score, segmented
from eitbench.envs.rendering import draw_electrodes, draw_field
from eitbench.physics.rest import AtRest
from eitbench.report.templates import template

if TYPE_CHECKING:
    from eitbench.bench.measured import Played
    from eitbench.envs.measured import MeasuredEnv
    from eitbench.estimation.measured.calibration import Calibration

BODIES = ListedColormap(["#f4f4f2", "#d1495b", "#0b6e75"])
"""Water, what conducts worse, what conducts better."""
FRAMES = 60
"""At most so many pictures in an animation."""
COLOURS = ("#0b6e75", "#d1495b", "#b8860b", "#7a5195", "#5b6770")
CORRECTED = {"offset": "What is left is taken off all readings.",
             "gain": "Each reading is divided by the factor that it is off by."}
LEAST = 1e-2
"""Misses and NIS are drawn from here on; in the frame that is homogeneous by definition there are
none."""
DECADES = 5.0
"""From this ratio of the largest to the smallest estimate on, colours are logarithmic."""
SHARE = (0.005, 0.995)
"""Quantiles of all estimates between which the colours lie."""


def write_report(path: Path, env: MeasuredEnv, played: Sequence[Played],
                 source: Mapping[str, Any], doubts: Sequence[str] = (),
                 truth: np.ndarray | None = None) -> Path:
    """An HTML page: the estimates, how well they predict what they were not shown, NIS over time,
    the calibration, and how each electrode does.

    Parameters
    ----------
    path : Path
        Of the page; its folder is made.
    env : MeasuredEnv
    played : sequence of Played
        The first is drawn.
    source : mapping
        Where the record comes from; its "file" is the page's title.
    doubts : sequence of str
        What is odd about the record.
    truth : (256, 256), optional
        Classes of pixels; see `eitbench.bench.segmentation`.
    """
    calibration = env.calibration
    page = template("measured.html.j2").render(
        title=str(source.get("file", "A record")),
        source={name: value for name, value in source.items() if name != "file"},
        methods=[_row(env, each) for each in played], doubts=list(doubts),
        facts=_facts(env), estimate=_estimate(env, played[0]), first=played[0].method,
        over_time=_figure(_over_time(env, played)), velocity=_velocity(env, played),
        fit=_figure(_fit(calibration)), corrected=CORRECTED[calibration.correction],
        contacts=_figure(_contacts(env)), health=_figure(_health(env, played[0])),
        at_rest=_is_at_rest(env),
        compared="" if truth is None else _figure(_compared(env, played, truth)))
    write_atomically(path, page.encode())
    return path


def _is_at_rest(env: MeasuredEnv) -> bool:
    return isinstance(env.task.transport, AtRest)


def _row(env: MeasuredEnv, played: Played) -> dict[str, str]:
    nis = played.nis[env.task.warm_up:]
    told = np.isfinite(nis)
    return {"method": played.method, "withheld": f"{played.withheld:.2f}",
            "nis": f"{nis[told].mean():.2f}" if told.any() else "–"}


def _facts(env: MeasuredEnv) -> dict[str, str]:
    """What was calibrated, in words."""
    calibration = env.calibration
    noise = env.task.noise
    record = env.record
    told = calibration.noise
    facts = {
        "readings": f"{len(record.injections)} times {len(record.matrix)}, of "
                    f"{len(record.currents)} different injections",
        "conductivity": f"{calibration.conductivity:.4g} S/m ± "
                        f"{100 * calibration.conductivity_std:.2g} %",
        "gain": f"{calibration.gain:.4g}",
        "contact impedances": f"{1e3 * calibration.contact_impedance.min():.3g} to "
                              f"{1e3 * calibration.contact_impedance.max():.3g} mΩ·m²",
        "noise of the instrument" if calibration.noise_is_told else "not explained by the model":
            f"{100 * told.relative:.2g} % of the reading and {1e3 * told.floor:.2g} mV",
        "noise that estimators are told": f"{100 * noise.relative:.2g} % of the reading and "
                                          f"{1e3 * noise.floor:.2g} mV",
        "initial state": f"± {100 * env.task.prior.initial_std:.3g} % of the background, smooth "
                         f"over {100 * env.task.prior.initial_length:.2g} cm"}
    if env.vessel.flow is not None and not _is_at_rest(env):
        flow = env.vessel.flow
        del facts["initial state"]
        facts["flow"] = (f"{flow.mean_velocity:.3g} m/s on average, "
                         + (f"± {flow.velocity_std:.2g} m/s" if flow.is_asked else "known"))
    elif not _is_at_rest(env):
        facts["walk"] = (f"± {100 * env.task.prior.nodal_std:.2g} % of the background a step of "
                         f"{1e3 * env.task.transport.time_step:.3g} ms")
    return facts


def _estimate(env: MeasuredEnv, played: Played) -> str:
    """The last estimate of a target at rest, or an animation, as a data URI."""
    T = env.episode_steps
    if _is_at_rest(env):
        return _figure(_picture(env, played, T))
    after = played.steps[played.steps > min(env.task.warm_up, T - 1)]
    at = after[np.unique(np.linspace(0, len(after) - 1, FRAMES).round().astype(int))]
    frames = [_image(_picture(env, played, int(t))) for t in at]
    content = io.BytesIO()
    frames[0].save(content, "webp", save_all=True, append_images=frames[1:], loop=0, duration=125,
                   quality=40, method=4)
    return "data:image/webp;base64," + base64.b64encode(content.getvalue()).decode()


def _picture(env: MeasuredEnv, played: Played, t: int) -> Figure:
    """Estimate and its standard deviation at t."""
    task = env.task
    conducts = 1e3 * env.calibration.conductivity / task.expected_concentration
    row = played.at(t)
    after = played.steps > min(task.warm_up, env.episode_steps - 1)
    shown = conducts * played.mean[after]
    low, high = np.quantile(shown, SHARE)
    field = conducts * played.mean[row]
    in_decades = shown.min() > 0.0 and high > DECADES * low
    if in_decades:
        field, low, high = (np.log10(each) for each in (field, low, high))
    spread = np.full(1, np.nan)
    if played.variance is not None:
        spread = conducts * np.sqrt(played.variance[row])
    panels = 2 if np.isfinite(spread).all() else 1
    figure = Figure(figsize=(5.2 * panels, 4.4), dpi=100, layout="constrained")
    axes = figure.subplots(1, panels, squeeze=False)[0]
    k = env.record.injections[t - 1]
    fields: list[tuple[np.ndarray, float, float, str, str]] = [
        (field, low, max(high, low + 1e-12), "viridis", "conductivity / (mS/m)")]
    if panels == 2:
        fields.append((spread, 0.0, float(spread.max()), "magma", "standard deviation / (mS/m)"))
    for ax, (values, least, most, colours, label) in zip(axes, fields, strict=True):
        mappable = draw_field(ax, task.mesh, values, least, most, colours)
        draw_electrodes(ax, task, env.record.currents[k], width=4.0)
        ax.set(xlabel="x / cm")
        bar = figure.colorbar(mappable, ax=ax, label=label, shrink=0.85)
        if in_decades and ax is axes[0]:
            bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{10**value:.3g}"))
    figure.suptitle(f"{played.method}, {env.record.times[t - 1]:.4g} s", fontsize=11)
    return figure


def _compared(env: MeasuredEnv, played: Sequence[Played], truth: np.ndarray) -> Figure:
    """Bodies of the truth, and of each method's last estimate."""
    figure = Figure(figsize=(3.0 * (1 + len(played)), 3.3), dpi=100, layout="constrained")
    axes = figure.subplots(1, 1 + len(played), squeeze=False)[0]
    side = 100 * check_tank(env).radius
    pictures = {"truth": truth}
    for each in played:
        found = segmented(env, each.mean[-1])
        pictures[f"{each.method}: {ktc_score(truth, found):.2f}"] = found
    for ax, (title, picture) in zip(axes, pictures.items(), strict=True):
        ax.imshow(picture, cmap=BODIES, vmin=0, vmax=2, extent=(-side, side, -side, side),
                  interpolation="nearest")
        ax.add_patch(Circle((0.0, 0.0), side, fill=False, color="0.4"))
        ax.set(title=title, xlabel="x / cm")
        _bare(ax)
    return figure


def _over_time(env: MeasuredEnv, played: Sequence[Played]) -> Figure:
    """Misses of withheld readings, and NIS, of each method."""
    figure = Figure(figsize=(10.5, 3.4), dpi=100, layout="constrained")
    missed, nis = figure.subplots(1, 2)
    if not any(np.isfinite(each.nis).any() for each in played):
        nis.set_axis_off()
    times = env.record.times
    frame = max(env.task.warm_up, 1)
    for each, colour in zip(played, COLOURS * len(played), strict=False):
        for ax, values in ((missed, each.missed**2), (nis, each.nis)):
            if np.isfinite(values).any():
                smooth = _smooth(values, frame)
                ax.plot(times, np.sqrt(smooth) if ax is missed else smooth, color=colour,
                        label=each.method, linewidth=1.6)
    for ax, title in ((missed, "withheld readings missed by / noise std"), (nis, "NIS/m")):
        ax.axhline(1.0, color="0.7", linewidth=1)
        ax.set(xlabel="time / s", ylabel=title, yscale="log")
        ax.set_ylim(bottom=max(ax.get_ylim()[0], LEAST))
        _bare(ax)
    missed.legend(frameon=False, fontsize=9)
    return figure


def _velocity(env: MeasuredEnv, played: Sequence[Played]) -> str:
    """What each method says of the flow, as a data URI; empty if it is not asked for."""
    if env.task.velocity is None:
        return ""
    figure = Figure(figsize=(10.5, 2.8), dpi=100, layout="constrained")
    axes = figure.subplots()
    for each, colour in zip(played, COLOURS * len(played), strict=False):
        if each.velocity is not None:
            axes.plot(env.record.times, each.velocity[:, 0], color=colour, label=each.method)
    axes.set(xlabel="time / s", ylabel="mean velocity / (m/s)")
    axes.legend(frameon=False, fontsize=9)
    _bare(axes)
    return _figure(figure)


def _smooth(values: np.ndarray, frame: int) -> np.ndarray:
    """Means over a frame, of what is there."""
    there = np.isfinite(values)
    weights = np.convolve(there.astype(float), np.ones(frame), "same")
    total = np.convolve(np.where(there, values, 0.0), np.ones(frame), "same")
    return np.where(weights > 0, total / np.maximum(weights, 1.0), np.nan)


def _fit(calibration: Calibration) -> Figure:
    """Measured against modelled readings of homogeneous fluid."""
    figure = Figure(figsize=(10.5, 3.6), dpi=100, layout="constrained")
    against, left = figure.subplots(1, 2)
    there = np.isfinite(calibration.measured)
    measured, computed = 1e3 * calibration.measured[there], 1e3 * calibration.computed[there]
    ends = [measured.min(), measured.max()]
    against.plot(ends, ends, color="0.8", linewidth=1)
    against.plot(computed, measured, ".", color=COLOURS[0], markersize=3)
    against.set(xlabel="modelled / mV", ylabel="measured / mV")
    left.plot(computed, measured - computed, ".", color=COLOURS[1], markersize=3)
    left.axhline(0.0, color="0.8", linewidth=1)
    left.set(xlabel="modelled / mV", ylabel="measured less modelled / mV")
    for ax in (against, left):
        _bare(ax)
    return figure


def _contacts(env: MeasuredEnv) -> Figure:
    """Contact impedances with their uncertainty, and what readings of each electrode miss."""
    calibration = env.calibration
    figure = Figure(figsize=(10.5, 3.2), dpi=100, layout="constrained")
    impedance, missed = figure.subplots(1, 2)
    number = np.arange(1, len(calibration.contact_impedance) + 1)
    z = 1e3 * calibration.contact_impedance
    factor = np.exp(calibration.contact_impedance_std)
    impedance.errorbar(number, z, [z - z / factor, z * factor - z], fmt="o", color=COLOURS[0],
                       markersize=4, linewidth=1)
    impedance.set(xlabel="electrode", ylabel="contact impedance / (mΩ·m²)", yscale="log")
    size = np.nanmean(np.abs(calibration.measured))
    off = np.nan_to_num(calibration.measured - calibration.computed)
    involved = (env.record.matrix != 0).astype(float)
    there = np.isfinite(calibration.measured).astype(float)
    count = np.maximum((there @ involved).sum(axis=0), 1.0)
    missed.bar(number, 100 * np.sqrt((off**2 @ involved).sum(axis=0) / count) / size,
               color=COLOURS[1])
    missed.set(xlabel="electrode", ylabel="misfit of its readings / %\nof the mean reading")
    for ax in (impedance, missed):
        _bare(ax)
    return figure


def _health(env: MeasuredEnv, played: Played) -> Figure:
    """Misfits of each electrode's readings over time; of a single frame as bars."""
    times, misfits = electrode_misfits(env, played)
    L = misfits.shape[1]
    figure = Figure(figsize=(10.5, 1.6 + 0.09 * L), dpi=100, layout="constrained")
    axes = figure.subplots()
    if len(times) == 1:
        axes.bar(np.arange(1, L + 1), misfits[0], color=COLOURS[1])
        axes.set(xlabel="electrode", ylabel="misfit of its readings / noise std")
    else:
        shown = np.log10(np.maximum(misfits.T, 1e-3))
        drawn = axes.pcolormesh(times, np.arange(1, L + 1), shown, cmap="magma", shading="nearest",
                                vmin=0.0, vmax=max(1.0, float(np.nanmax(shown))))
        axes.set(xlabel="time / s", ylabel="electrode")
        axes.invert_yaxis()
        bar = figure.colorbar(drawn, ax=axes, label="misfit / noise std")
        bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{10**value:.3g}"))
    _bare(axes)
    return figure


def _bare(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)


def _image(figure: Figure) -> Image.Image:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())


def _figure(figure: Any) -> str:
    content = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(content, format="png")
    return "data:image/png;base64," + base64.b64encode(content.getvalue()).decode()
