"""How far filters with a learned prior have come: `python studies/frontier.py`, some minutes.

Draws three pictures of Pipe2D into docs/: truth, thesis filter and best filter side by side
(dev:0), what their intervals hold (dev:0-7), and error against time, beside the 5 ms in which the
instrument measures (dev:0-7; processor time of one thread, with all models made before).
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from thesis.common import ACCENT, INK, bare, comparison, error_of, estimates_of, save

from eitbench import scoring
from eitbench.data.episode_cache import score_operators
from eitbench.data.seeds import parse_seeds
from eitbench.envs.estimation import EstimationEnv
from eitbench.worlds.task import Estimate

ID = "eitbench/Pipe2D-v0"
DOCS = Path(__file__).parents[1] / "docs"
SHOWN = {"kalman_filter": "Kalman filter (thesis)", "identified_flow": "learned inflow and flow"}
COLOURS = {"kalman_filter": "0.6", "extended_kalman_filter": "0.35", "log_inflow_filter": ACCENT,
           "identified_flow": INK}
"""Of the methods whose intervals are drawn."""
ABOVE, BELOW = (0, 8, "center"), (0, -14, "center")
LEFT, RIGHT = (-3, -14, "right"), (3, -14, "left")
TIMED = {"kalman_filter": BELOW, "extended_kalman_filter": ABOVE,
         "coloured_extended_kalman_filter": ABOVE, "log_inflow_filter": LEFT,
         "identified_flow": RIGHT, "real_time_filter": BELOW, "joint_inflow_filter": ABOVE,
         "learned_correction": ABOVE}
"""Where their names are written."""
PLAYED = parse_seeds("dev:0-7")
LEVELS = np.linspace(0.05, 0.95, 19)
INSTRUMENT = 5.0
"""ms between two injections"""


def main() -> None:
    env = EstimationEnv(ID)
    columns = {}
    for name, title in SHOWN.items():
        columns[title] = estimates_of(env, name, PLAYED[0])
    comparison(DOCS / "frontier.png", env, columns)
    errors, milliseconds = {}, {}
    intervals: dict[str, list[np.ndarray]] = {name: [] for name in COLOURS}
    for name in TIMED:
        estimates_of(env, name, PLAYED[0])                                   # its models are made
        scores, spent = [], 0.0
        for seed in PLAYED:
            env.reset(seed=seed)
            begun = time.process_time()
            estimates = estimates_of(env, name, seed)
            spent += time.process_time() - begun
            scores.append(error_of(env, estimates))
            if name in intervals:
                intervals[name].append(held(env, estimates))
        errors[name] = float(np.mean(scores))
        milliseconds[name] = 1e3 * spent / (len(PLAYED) * env.task.n_steps)
        print(f"{name}: ẽ_c {errors[name]:.5f}, {milliseconds[name]:.1f} ms a step", flush=True)
    draw_coverage({name: np.mean(parts, axis=0) for name, parts in intervals.items()},
                  DOCS / "frontier_calibration.png")
    draw_time(milliseconds, errors, DOCS / "frontier_time.png")


def held(env: EstimationEnv, estimates: list[Estimate]) -> np.ndarray:
    """Part of space and time where the truth lies within the interval of each of `LEVELS`."""
    interpolation, mass = score_operators(env.world)
    scored = [each for each in estimates[env.task.warm_up:] if each.variance is not None]
    mean = np.array([interpolation @ each.mean for each in scored])
    std = np.sqrt([np.maximum(interpolation @ each.variance, 0.0) for each in scored])
    truth = env.truth()[env.task.warm_up:]
    weights = mass.sum(axis=0)
    return np.array([scoring.coverage(mean, std, truth, weights, level) for level in LEVELS])


def draw_coverage(intervals: dict[str, np.ndarray], path: Path) -> None:
    """What intervals hold, against what they should."""
    figure = Figure(figsize=(4.5, 4.4), dpi=130, layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 100], [0, 100], color="0.8", linewidth=1)
    for name, parts in intervals.items():
        print(f"{name}: 90 % intervals hold {100 * np.interp(0.9, LEVELS, parts):.0f} %")
        axes.plot(100 * LEVELS, 100 * parts, color=COLOURS[name], label=name)
    axes.set(xlabel="interval / %", ylabel="of the truth lies within / %", xlim=(0, 100),
             ylim=(0, 100), aspect="equal")
    axes.legend(frameon=False, fontsize=9)
    bare(axes)
    save(figure, path)


def draw_time(milliseconds: dict[str, float], errors: dict[str, float], path: Path) -> None:
    """Error against time a step."""
    figure = Figure(figsize=(7.6, 4.2), dpi=130, layout="constrained")
    axes = figure.subplots()
    begin = 0.6 * min(*milliseconds.values(), INSTRUMENT)
    axes.axvspan(begin, INSTRUMENT, color=INK, alpha=0.08, linewidth=0)
    axes.axvline(INSTRUMENT, color=INK, linestyle="--", linewidth=1)
    axes.text(0.96 * INSTRUMENT, max(errors.values()), "as fast as\nthe instrument", color=INK,
              ha="right", va="top", fontsize=9)
    for name, (right, up, side) in TIMED.items():
        at = (milliseconds[name], errors[name])
        axes.loglog(*at, "o", color=ACCENT, markersize=5)
        axes.annotate(name, at, xytext=(right, up), textcoords="offset points", fontsize=8,
                      ha=side)
    low, high = min(errors.values()), max(errors.values())
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(FuncFormatter(lambda value, _: ""))
    axes.set_xticks([2, 5, 10, 20, 50])
    axes.set_yticks([0.002, 0.003, 0.004, 0.005])
    axes.set(xlabel="processor time a step / ms", ylabel="ẽ_c", ylim=(0.7 * low, 1.3 * high),
             xlim=(begin, 2.0 * max(milliseconds.values())))
    bare(axes)
    save(figure, path)


if __name__ == "__main__":
    main()
