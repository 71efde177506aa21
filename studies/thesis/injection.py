"""What choosing the injection is worth: scores by policy, learning curves, and a policy at work."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from eitbench._files import shipped
from eitbench.bench.methods import baseline_folder
from eitbench.bench.run import pending_jobs, run_jobs
from eitbench.bench.store import EpisodeStore, folder_results
from eitbench.bench.suites import jobs as jobs_of
from eitbench.bench.text import mean_and_interval
from eitbench.data.seeds import name_seed
from eitbench.report.animate import animate
from eitbench.report.policies import OPEN_LOOP, errors_by_policy, gap_text, policy_rows

from .common import ACCENT, INK, TRUE, bare, save

WORLDS = {"eitbench/Pipe2DInjectionFaults-v0": "faulty electrodes",
          "eitbench/Pipe2DInjectionBudget-v0": "a budget",
          "eitbench/Pipe2DInjectionFlow-v0": "unknown flow",
          "eitbench/Pipe2DInjection-v0": "plain pipe (reference)",
          "eitbench/Pipe2DInjectionCurrents-v0": "any currents (reference)",
          "eitbench/RotatingTankInjection-v0": "stirred tank (reference)"}
KINDS = {INK: "open loop", ACCENT: "looks at the data", TRUE: "* is shown the truth"}
THIN, THICK = 1.2, 4.0
LINES = {THIN: "95 % interval",
         THICK: "95 % interval of the paired difference to the best that ranks"}
COMPETITIONS = list(WORLDS)[:3]
"""Where agents have learnt."""
AT_WORK = ("eitbench/Pipe2DInjectionFaults-v0", "fault_aware")
"""What the animation shows."""


def injection(seeds: list[int] | None, jobs: int, out: Path) -> tuple[Path, str]:
    """Scores with the exact filter, of all our policies on these episodes, by default the boards';
    what the leaderboards' records hold, of this very code, is not played again. An episode with an
    unknown flow takes one to two minutes."""
    store = EpisodeStore(out)
    before = folder_results(shipped("leaderboards") / "results")
    figure = Figure(figsize=(13.5, 13.8), dpi=110, layout="constrained")
    panels = figure.subplots(3, 3, height_ratios=(4, 4, 3))
    said = []
    for (env, title), axes in zip(WORLDS.items(), panels[:2].flat, strict=True):
        todo = jobs_of("injection", [env], [], seeds)
        run_jobs(pending_jobs(todo, before), store, n_jobs=jobs,
                 command="python studies/thesis injection")
        rows = policy_rows(todo, [*before, *store.results()])
        privileged = sorted({job.load().name for job in todo if job.load().privileged})
        _scores(axes, rows, privileged)
        axes.set_title(title, fontsize=11)
        means = errors_by_policy(rows).agg(["mean", "std", "count"]).T
        table = means.to_string(float_format="{:.3g}".format)
        said.append(f"{env}\n{table}\n{gap_text(rows)}\n")
    for env, axes in zip(COMPETITIONS, panels[2], strict=True):
        _curves(axes, env)
        axes.set_title(WORLDS[env], fontsize=11)
    figure.legend(handles=[Line2D([], [], marker="o", linestyle="", color=colour, label=meaning)
                           for colour, meaning in KINDS.items()]
                  + [Line2D([], [], color=TRUE, linewidth=width, label=meaning)
                     for width, meaning in LINES.items()],
                  frameon=False, ncols=5, loc="outside upper center")
    path = out / "injection.png"
    save(figure, path)
    env, policy = AT_WORK
    first = jobs_of("injection", [env], [policy], seeds)[0].seed
    moving = animate(env, [policy], name_seed(first), None, out / "injection.gif")
    return path, "\n".join([*said, f"wrote {moving}: {policy} in {env}"])


def _scores(axes: Axes, rows: pd.DataFrame, privileged: list[str]) -> None:
    """A dot for each policy, the best above; thin, the 95 % interval over episodes, which differ in
    how hard they are; thick, that of the difference to the best one that is not privileged, episode
    by episode."""
    errors = errors_by_policy(rows)
    order = list(errors)[::-1]
    best = errors[[name for name in order if name not in privileged][-1]]
    axes.axvline(best.mean(), color=TRUE, linewidth=0.6, linestyle=":", zorder=0)
    for place, name in enumerate(order):
        mean = errors[name].mean()
        blind = name in OPEN_LOOP or name == "random_pair"
        colour = TRUE if name in privileged else INK if blind else ACCENT
        axes.plot([mean], [place], "o", color=colour, markersize=5)
        for width, values in ((THIN, errors[name]), (THICK, errors[name] - best)):
            _, half = mean_and_interval(list(values.dropna()))
            if np.isfinite(half):
                axes.plot([mean - half, mean + half], [place, place], color=colour, linewidth=width,
                          solid_capstyle="butt")
    axes.set_yticks(range(len(order)),
                    [name.replace("_", " ") + " *" * (name in privileged) for name in order])
    axes.set(xlim=(0, None), xlabel=f"ẽ$_c$, {len(errors)} episode{'s' * (len(errors) > 1)}")
    axes.locator_params(axis="x", nbins=5)
    axes.tick_params(axis="y", length=0)
    bare(axes)


def _curves(axes: Axes, env: str) -> None:
    """Scores on dev episodes while agents learnt, one line a training seed."""
    runs = sorted((baseline_folder() / "checkpoints"
                   / env.replace("/", "-")).glob("*/seed*/evaluations.npz"))
    colours = dict(zip(sorted({run.parts[-3] for run in runs}), (ACCENT, INK, TRUE), strict=False))
    seen = set()
    for run in runs:
        algo = json.loads((run.parent / "config.json").read_text())["algo"]
        kept = np.load(run)
        axes.plot(1e-6 * kept["steps"], kept["errors"].mean(axis=1), color=colours[run.parts[-3]],
                  linewidth=1.2,
                  label=None if algo in seen else f"{algo}, reduced filter, dev episodes")
        seen.add(algo)
    axes.legend(frameon=False, fontsize=8)
    axes.set(xlabel="million environment steps of reinforcement", ylabel="ẽ$_c$")
    axes.margins(y=0.25)
    bare(axes)
