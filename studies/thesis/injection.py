"""Value of adaptive injection: scores by policy, learning curves, and an animation."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from eitbench._files import bundled_path
from eitbench.bench.methods import baseline_folder
from eitbench.bench.run import make_jobs, pending_jobs, run_jobs
from eitbench.bench.store import EpisodeStore, folder_results
from eitbench.bench.text import mean_and_interval
from eitbench.data.seeds import format_seed
from eitbench.report.animate import animate
from eitbench.report.policies import OPEN_LOOP, errors_by_policy, gap_text, policy_rows

from .common import ACCENT, GREY, INK, despine, save_figure

WORLDS = {"eitbench/Pipe2DInjectionFaults-v0": "faulty electrodes",
          "eitbench/Pipe2DInjectionInflowBudget-v0": "a budget",
          "eitbench/Pipe2DInjectionFlow-v0": "unknown flow",
          "eitbench/TankTracking-v0": "a moving body",
          "eitbench/SearchAndTrack-v0": "a body that comes and goes",
          "eitbench/BubbleTracking-v0": "bubbles in a pipe"}
KINDS = {INK: "open loop", ACCENT: "adaptive", GREY: "* uses the ground truth"}
THIN, THICK = 1.2, 4.0
LINES = {THIN: "95 % interval",
         THICK: "95 % interval of the paired difference to the best ranked policy"}
ADAPTIVE_ENVS = list(WORLDS)[:3]
"""Environments whose agents learn by reinforcement."""
ANIMATED = ("eitbench/Pipe2DInjectionFaults-v0", "fault_aware")
"""Environment and policy of the animation."""


def injection(seeds: list[int] | None, jobs: int, out: Path) -> tuple[Path, str]:
    """Draw scores with the full filter of all built-in policies, by default on the episodes of the
    leaderboards.

    Episodes of current records are not run again. An episode with an unknown flow takes one to two
    minutes.
    """
    store = EpisodeStore(out)
    recorded = folder_results(bundled_path("leaderboards") / "results")
    figure = Figure(figsize=(13.5, 13.8), dpi=110, layout="constrained")
    panels = figure.subplots(3, 3, height_ratios=(4, 4, 3))
    tables = []
    for (env, title), axes in zip(WORLDS.items(), panels[:2].flat, strict=True):
        todo = make_jobs("injection", [env], [], seeds)
        run_jobs(pending_jobs(todo, recorded), store, n_jobs=jobs,
                 command="python studies/thesis injection")
        rows = policy_rows(todo, [*recorded, *store.results()])
        methods = [job.load() for job in {job.method: job for job in todo}.values()]
        privileged = sorted({method.name for method in methods if method.privileged})
        _scores(axes, rows, privileged)
        axes.set_title(title, fontsize=11)
        means = errors_by_policy(rows).agg(["mean", "std", "count"]).T
        table = means.to_string(float_format="{:.3g}".format)
        tables.append(f"{env}\n{table}\n{gap_text(rows)}\n")
    for env, axes in zip(ADAPTIVE_ENVS, panels[2], strict=True):
        _curves(axes, env)
        axes.set_title(WORLDS[env], fontsize=11)
    figure.legend(handles=[Line2D([], [], marker="o", linestyle="", color=colour, label=meaning)
                           for colour, meaning in KINDS.items()]
                  + [Line2D([], [], color=GREY, linewidth=width, label=meaning)
                     for width, meaning in LINES.items()],
                  frameon=False, ncols=5, loc="outside upper center")
    path = out / "injection.png"
    save_figure(figure, path)
    env, policy = ANIMATED
    first = make_jobs("injection", [env], [policy], seeds)[0].seed
    animation = animate(env, [policy], format_seed(first), None, out / "injection.gif")
    return path, "\n".join([*tables, f"wrote {animation}: {policy} in {env}"])


def _scores(axes: Axes, rows: pd.DataFrame, privileged: list[str]) -> None:
    """Draw the mean error of each policy, the smallest at the top, with two 95 % intervals.

    The thin interval is over episodes, the thick interval of the paired difference to the best
    policy without privileged information.
    """
    errors = errors_by_policy(rows)
    order = list(errors)[::-1]
    best = errors[[name for name in order if name not in privileged][-1]]
    axes.axvline(best.mean(), color=GREY, linewidth=0.6, linestyle=":", zorder=0)
    for position, name in enumerate(order):
        mean = errors[name].mean()
        open_loop = name in OPEN_LOOP or name == "random_pair"
        colour = GREY if name in privileged else INK if open_loop else ACCENT
        axes.plot([mean], [position], "o", color=colour, markersize=5)
        for width, values in ((THIN, errors[name]), (THICK, errors[name] - best)):
            _, half = mean_and_interval(list(values.dropna()))
            if np.isfinite(half):
                axes.plot([mean - half, mean + half], [position, position], color=colour,
                          linewidth=width, solid_capstyle="butt")
    axes.set_yticks(range(len(order)),
                    [name.replace("_", " ") + " *" * (name in privileged) for name in order])
    axes.set(xlim=(0, None), xlabel=f"ẽ$_c$, {len(errors)} episode{'s' * (len(errors) > 1)}")
    axes.locator_params(axis="x", nbins=5)
    axes.tick_params(axis="y", length=0)
    despine(axes)


def _curves(axes: Axes, env: str) -> None:
    """Draw scores on dev episodes during training, one line for each training seed."""
    runs = sorted((baseline_folder() / "checkpoints"
                   / env.replace("/", "-")).glob("*/seed*/evaluations.npz"))
    colours = dict(zip(sorted({run.parts[-3] for run in runs}), (ACCENT, INK, GREY), strict=False))
    labelled = set()
    for run in runs:
        algo = json.loads((run.parent / "config.json").read_text())["algo"]
        evaluations = np.load(run)
        axes.plot(1e-6 * evaluations["timesteps"], evaluations["errors"].mean(axis=1),
                  color=colours[run.parts[-3]], linewidth=1.2,
                  label=None if algo in labelled else f"{algo}, reduced filter, dev episodes")
        labelled.add(algo)
    axes.legend(frameon=False, fontsize=8)
    axes.set(xlabel="million environment steps of RL", ylabel="ẽ$_c$")
    axes.margins(y=0.25)
    despine(axes)
