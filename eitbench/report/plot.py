"""Figures for scripts and notebooks as matplotlib axes: ``eitbench.plot``."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter
from tqdm import tqdm

from eitbench import _check, scoring
from eitbench.bench.evaluation import resolve_environment, resolve_method
from eitbench.bench.methods import Method
from eitbench.bench.runner import is_compatible, iter_estimates, iter_injections
from eitbench.bench.scores import scores
from eitbench.bench.text import mean_and_interval
from eitbench.bench.tracks import subtrack_of
from eitbench.data.episode_cache import score_operators, truth_mesh
from eitbench.data.episodes import simulate
from eitbench.data.seeds import format_seed, parse_seeds
from eitbench.envs.injection import InjectionEnv
from eitbench.envs.rendering import colour_range, draw_electrodes, draw_field
from eitbench.numerics.mesh import Mesh
from eitbench.worlds.task import Task

FIELD_LABEL = "concentration / (mol/m³)"


def field(task: Task, c: Any, ax: Axes | None = None, *, currents: Any = None,
          colour_bar: bool = True) -> Axes:
    """Draw a concentration within the electrodes of a task.

    Parameters
    ----------
    task : Task
    c : (n,) array or Estimate
        mol/m³ at the nodes of ``task.mesh``; of an estimate the mean.
    ax : Axes, optional
        Axes to draw on; default: axes of a new figure.
    currents : (L,) array, optional
        In A: the electrode where a current enters is red, where it leaves blue.
    colour_bar : bool

    Returns
    -------
    Axes
        In cm. All fields of one task have one colour scale. In 3D the slice along the axis.

    ``ValueError`` if ``c`` or ``currents`` has another shape, or is not finite.
    """
    values = _check.array("c", getattr(c, "mean", c) if isinstance(c, tuple) else c,
                          (task.mesh.n_nodes,), units="mol/m³")
    L = task.currents.shape[1]
    current = np.zeros(L) if currents is None else _check.array("currents", currents, (L,))
    if ax is None:
        import matplotlib.pyplot as plt
        ax = plt.subplots(figsize=_size(task, 1, 1), layout="constrained")[1]
    drawn = _draw_panel(ax, task, task.mesh, values, current)
    if colour_bar:
        drawn.axes.figure.colorbar(drawn, ax=ax, label=FIELD_LABEL, extend="both")
    return ax


def episode(method: Any, env: str | gym.Env, seed: int | str, *,
            world: dict[str, Any] | None = None, times: int = 4) -> np.ndarray:
    """Run a method on an episode, and draw truth and estimate side by side.

    The method's code runs in this process and can access the ground truth, files and the network.

    Parameters
    ----------
    method, env, world
        As in `eitbench.evaluate`. For a policy the estimate is the environment's.
    seed : int or str
        The episode, as in ``"dev:0"``.
    times : int
        Number of scored states, uniformly distributed over the episode.

    Returns
    -------
    (times, 2) array of Axes
        Titles have the time and ẽ_c of the estimate.

    ``ValueError`` if an argument is wrong, or the method does not suit the environment.
    """
    import matplotlib.pyplot as plt
    asked = resolve_environment(env, world=world)
    loaded = resolve_method(method, asked.track)
    number = parse_single_seed(seed)
    made = asked.make()
    world_of = made.world
    _check.integer("times", times, low=1, high=world_of.schedule.scored_steps)
    wanted = list(map(int, np.linspace(world_of.warm_up + 1, world_of.n_steps, times + 2)[1:-1]))
    found = states_at(made, loaded, number, wanted)
    mesh = truth_mesh(world_of)
    interpolation, mass = score_operators(world_of)
    task = made.task
    figure, axes = plt.subplots(times, 2, figsize=_size(task, times, 2), squeeze=False,
                                sharex=True, sharey=True, layout="constrained")
    for row, t in zip(axes, wanted, strict=True):
        truth, mean, currents = found[t]
        error = scoring.step_errors((interpolation @ mean)[None], truth[None], mass)[0]
        last = _draw_panel(row[0], task, mesh, truth, currents)
        _draw_panel(row[1], task, task.mesh, mean, currents)
        row[0].set_title(f"truth, t = {1e3 * t * world_of.time_step:.0f} ms", fontsize=9)
        row[1].set_title(f"{loaded.name}, ẽ_c = {error:.2g}", fontsize=9)
    for ax in axes.flat:
        ax.label_outer()
    figure.colorbar(last, ax=axes, label=FIELD_LABEL, extend="both")
    figure.suptitle(f"{asked.id}, {format_seed(number)}", fontsize=10)
    return axes


def compare(table: pd.DataFrame | Iterable[pd.DataFrame], ax: Axes | None = None, *,
            score: str = "error") -> Axes:
    """Draw the scores of methods below each other, the best first: a dot for each episode, and
    their mean with its 95 % interval.

    Parameters
    ----------
    table : DataFrame, or several
        As `eitbench.evaluate` returns them.
    ax : Axes, optional
        Axes to draw on; default: axes of a new figure.
    score : str
        A column of the tables.

    ``ValueError`` if the table or the column is missing, or no method has the score.
    """
    tables = [table] if isinstance(table, pd.DataFrame) else list(table)
    if not tables or not all(isinstance(each, pd.DataFrame) for each in tables):
        kinds = ", ".join(type(each).__name__ for each in tables)
        raise ValueError("table must be a DataFrame or several, as eitbench.evaluate returns them, "
                         f"got {kinds or 'none'}")
    rows = pd.concat(tables)
    _check.choice("score", score, [name for name in rows if name in scores()])
    several = rows["environment"].nunique() > 1
    names = rows["method"] + (", " + rows["environment"] if several else "")
    asked = scores()[score]
    values = (asked.factor * rows[score].dropna().astype(float)).groupby(names)
    order = values.mean().sort_values(ascending=asked.direction == "higher").index
    if order.empty:
        raise ValueError(f"table must have a method with the score {score}, got none")
    if ax is None:
        import matplotlib.pyplot as plt
        ax = plt.subplots(figsize=(6.4, 1.2 + 0.4 * len(order)), layout="constrained")[1]
    for place, name in enumerate(order):
        own = values.get_group(name)
        mean, half = mean_and_interval(list(own))
        ax.plot(own, np.full(len(own), place + 0.2), "o", color="#2e86ab", markersize=4)
        ax.errorbar(mean, place, xerr=half if np.isfinite(half) else None, fmt="o", color="#1b4965",
                    capsize=4, markersize=6)
    if values.min().min() > 0:
        ax.set_xscale("log")
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.xaxis.set_major_formatter(lambda value, place: f"{value:g}")
        ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set_yticks(range(len(order)), order)
    ax.set_ylim(-0.6, len(order) - 0.4)
    ax.set_xlabel(asked.heading)
    ax.grid(axis="x", alpha=0.3)
    return ax


def parse_single_seed(seed: int | str) -> int:
    """Return the number of an episode; ``ValueError`` unless ``seed`` names one."""
    if not isinstance(seed, str):
        return _check.integer("seed", seed, low=0)
    numbers = parse_seeds(seed)
    if len(numbers) != 1:
        raise ValueError(f"seed must name one episode, as in 'dev:0', got {seed!r}")
    return numbers[0]


def run_until(env: Any, method: Method, seed: int, last: int) -> Iterator[Any]:
    """Yield what `iter_estimates` or `iter_injections` yields up to the state t = ``last``;
    ``ValueError`` if the method is not compatible with the environment."""
    if not is_compatible(method, env):
        raise ValueError(f"method {method.name} for {', '.join(method.subtracks)} is not "
                         f"compatible with {env.spec.id}, a {subtrack_of(env)} environment")
    steps = iter_injections if isinstance(env, InjectionEnv) else iter_estimates
    for state in tqdm(steps(env, method, seed), total=last, desc="running", unit="state",
                      disable=None):
        yield state
        if state[0] == last:
            break


def states_at(env: Any, method: Method, seed: int, wanted: Collection[int],
              ) -> dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return t -> truth (m,) and estimate (n,) in mol/m³, and currents (L,) in A, of the wanted
    states."""
    cycle, found = env.world.currents, {}
    for t, said, *_ in run_until(env, method, seed, max(wanted)):
        if t in wanted:
            mean, currents = ((env.core.estimate()[0][0], said["currents"])
                              if isinstance(env, InjectionEnv)
                              else (said.mean, cycle[(t - 1) % len(cycle)]))
            found[t] = np.array(mean, dtype=float), currents
    truth = simulate(env.world, seed).concentration
    return {t: (truth[t].astype(float), *state) for t, state in found.items()}


def _draw_panel(ax: Axes, task: Task, mesh: Mesh, values: np.ndarray,
                currents: np.ndarray) -> Any:
    drawn = draw_field(ax, mesh, values, *colour_range(task))
    draw_electrodes(ax, task, currents, width=3.0)
    ax.set_xlabel("z / cm" if mesh.dim == 3 else "x / cm")
    return drawn


def _size(task: Task, rows: int, columns: int) -> tuple[float, float]:
    """Return the size in inches of a figure with rows × columns fields."""
    extent = np.ptp(task.mesh.points, axis=0)
    length, height = (extent[2], extent[1]) if task.mesh.dim == 3 else extent
    width = 5.0 if length > 2 * height else 3.0
    return 1.2 + columns * width, 0.6 + rows * (width * height / length + 0.4)
