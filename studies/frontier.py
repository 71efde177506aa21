"""Error, time and calibration of filters with a fitted prior: `python studies/frontier.py`, some
minutes.

Draws three pictures of Pipe2D into docs/: ground truth, thesis filter and best filter (dev:0),
coverage of their intervals (dev:0-7), and error vs. time per step with the 5 ms between two
injections of the instrument (dev:0-7; processor time of one thread without building models).
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from thesis.common import (
    ACCENT,
    INK,
    despine,
    draw_comparison,
    episode_error,
    run_baseline,
    save_figure,
)

from eitbench import scoring
from eitbench.data.episode_cache import score_operators
from eitbench.data.seeds import parse_seeds
from eitbench.envs.estimation import EstimationEnv
from eitbench.worlds.task import Estimate

ID = "eitbench/Pipe2D-v0"
DOCS = Path(__file__).parents[1] / "docs"
SNAPSHOT_METHODS = {"kalman_filter": "Kalman filter (thesis)",
                    "identified_flow": "fitted inflow and flow"}
COLOURS = {"kalman_filter": "0.6", "extended_kalman_filter": "0.35", "log_inflow_filter": ACCENT,
           "identified_flow": INK}
"""Colours of the methods whose coverage is drawn."""
ABOVE, BELOW = (0, 8, "center"), (0, -14, "center")
LEFT, RIGHT = (-3, -14, "right"), (3, -14, "left")
TIMED = {"kalman_filter": BELOW, "extended_kalman_filter": ABOVE,
         "coloured_extended_kalman_filter": ABOVE, "log_inflow_filter": LEFT,
         "identified_flow": RIGHT, "real_time_filter": BELOW, "joint_inflow_filter": ABOVE,
         "learned_correction": ABOVE}
"""Positions of the labels."""
EPISODES = parse_seeds("dev:0-7")
LEVELS = np.linspace(0.05, 0.95, 19)
INSTRUMENT_MS = 5.0
"""Time between two injections."""


def main() -> None:
    env = EstimationEnv(ID)
    columns = {}
    for name, title in SNAPSHOT_METHODS.items():
        columns[title] = run_baseline(env, name, EPISODES[0])
    draw_comparison(DOCS / "frontier.png", env, columns)
    errors, milliseconds = {}, {}
    intervals: dict[str, list[np.ndarray]] = {name: [] for name in COLOURS}
    for name in TIMED:
        run_baseline(env, name, EPISODES[0])                                   # builds its models
        scores, seconds = [], 0.0
        for seed in EPISODES:
            env.reset(seed=seed)
            started = time.process_time()
            estimates = run_baseline(env, name, seed)
            seconds += time.process_time() - started
            scores.append(episode_error(env, estimates))
            if name in intervals:
                intervals[name].append(coverage(env, estimates))
        errors[name] = float(np.mean(scores))
        milliseconds[name] = 1e3 * seconds / (len(EPISODES) * env.task.n_steps)
        print(f"{name}: ẽ_c {errors[name]:.5f}, {milliseconds[name]:.1f} ms a step", flush=True)
    draw_coverage({name: np.mean(values, axis=0) for name, values in intervals.items()},
                  DOCS / "frontier_calibration.png")
    draw_time(milliseconds, errors, DOCS / "frontier_time.png")


def coverage(env: EstimationEnv, estimates: list[Estimate]) -> np.ndarray:
    """Return the fraction of space and time where intervals of each of the `LEVELS` contain the
    truth."""
    interpolation, mass = score_operators(env.world)
    scored = [each for each in estimates[env.task.warm_up:] if each.variance is not None]
    mean = np.array([interpolation @ each.mean for each in scored])
    std = np.sqrt([np.maximum(interpolation @ each.variance, 0.0) for each in scored])
    truth = env.truth()[env.task.warm_up:]
    weights = mass.sum(axis=0)
    return np.array([scoring.coverage(mean, std, truth, weights, level) for level in LEVELS])


def draw_coverage(intervals: dict[str, np.ndarray], path: Path) -> None:
    """Draw the coverage over the nominal level."""
    figure = Figure(figsize=(4.5, 4.4), dpi=130, layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 100], [0, 100], color="0.8", linewidth=1)
    for name, values in intervals.items():
        print(f"{name}: coverage of 90 % intervals {100 * np.interp(0.9, LEVELS, values):.0f} %")
        axes.plot(100 * LEVELS, 100 * values, color=COLOURS[name], label=name)
    axes.set(xlabel="level of the interval / %", ylabel="coverage / %", xlim=(0, 100),
             ylim=(0, 100), aspect="equal")
    axes.legend(frameon=False, fontsize=9)
    despine(axes)
    save_figure(figure, path)


def draw_time(milliseconds: dict[str, float], errors: dict[str, float], path: Path) -> None:
    """Draw the error over the time per step."""
    figure = Figure(figsize=(7.6, 4.2), dpi=130, layout="constrained")
    axes = figure.subplots()
    start = 0.6 * min(*milliseconds.values(), INSTRUMENT_MS)
    axes.axvspan(start, INSTRUMENT_MS, color=INK, alpha=0.08, linewidth=0)
    axes.axvline(INSTRUMENT_MS, color=INK, linestyle="--", linewidth=1)
    axes.text(0.96 * INSTRUMENT_MS, max(errors.values()), "real time", color=INK,
              ha="right", va="top", fontsize=9)
    for name, (right, up, side) in TIMED.items():
        point = (milliseconds[name], errors[name])
        axes.loglog(*point, "o", color=ACCENT, markersize=5)
        axes.annotate(name, point, xytext=(right, up), textcoords="offset points", fontsize=8,
                      ha=side)
    low, high = min(errors.values()), max(errors.values())
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(FuncFormatter(lambda value, _: ""))
    axes.set_xticks([2, 5, 10, 20, 50])
    axes.set_yticks([0.002, 0.003, 0.004, 0.005])
    axes.set(xlabel="processor time per step / ms", ylabel="ẽ_c", ylim=(0.7 * low, 1.3 * high),
             xlim=(start, 2.0 * max(milliseconds.values())))
    despine(axes)
    save_figure(figure, path)


if __name__ == "__main__":
    main()
