"""Estimate what a record of a real instrument saw, and judge it without a truth."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from eitbench._files import write_atomically
from eitbench.bench.methods import load_method
from eitbench.bench.playing import estimates
from eitbench.estimation.measured.readings import ReadingModel
from eitbench.estimation.walk import RandomWalk
from eitbench.physics.rest import AtRest

if TYPE_CHECKING:
    from eitbench.envs.measured import MeasuredEnv
    from eitbench.worlds.task import Estimate, Task


COLUMNS = 60
"""frames at which electrodes are looked at, at most"""


@dataclass(frozen=True, eq=False)
class Played:
    """What a method says of a record, t = 1 … T."""

    method: str
    steps: np.ndarray
    """(S,) t of the estimates that are kept, increasing; of a short record all"""
    mean: np.ndarray
    """(S, n) mol/m³ at the nodes of the task's mesh"""
    variance: np.ndarray | None
    """(S, n) (mol/m³)², if the method says it of each state after the first frame; NaN within"""
    nis: np.ndarray
    """(T,) νᵀS⁻¹ν in parts of the readings shown; NaN where a method says none"""
    missed: np.ndarray
    """(T,) root mean square of the withheld readings' distance from what the estimate that they
    judge predicts, in standard deviations of the noise; NaN where nothing is judged"""
    velocity: np.ndarray | None = None
    """(T, k) m/s, the flow's parameters if they are asked for; as believed at first where a method
    says nothing of them"""

    def save(self, path: Path, env: MeasuredEnv) -> None:
        """Write what is said as npz, whole or not at all: ``steps`` (S,), ``mean`` and ``variance``
        (S, n), ``nis`` and ``missed`` (T,), ``velocity`` (T, k) if it is asked for, ``times`` (T,)
        in s, and the mesh's ``points`` (n, d) in m and ``cells``."""
        content = io.BytesIO()
        mesh = env.task.mesh
        said: dict[str, Any] = {
            "steps": self.steps, "mean": self.mean, "nis": self.nis, "missed": self.missed,
            "times": env.record.times, "points": mesh.points, "cells": mesh.cells}
        said |= {name: value for name, value in (("variance", self.variance),
                                                 ("velocity", self.velocity)) if value is not None}
        np.savez_compressed(content, **said)
        write_atomically(path, content.getvalue())

    def at(self, t: int) -> int:
        """The row of the estimate at t; ``ValueError`` if it is not kept."""
        row = int(np.searchsorted(self.steps, t))
        if row == len(self.steps) or self.steps[row] != t:
            raise ValueError(f"t must be a step of which the estimate is kept, got {t}")
        return row

    @property
    def withheld(self) -> float:
        """Root mean square of `missed`: 1 is as good as the noise lets one be."""
        return float(np.sqrt(np.nanmean(self.missed**2)))


def play_record(env: MeasuredEnv, method: str, seed: int = 0, *,
                kept: np.ndarray | None = None) -> Played:
    """Play one of our methods, or the one of a path, on a record; errors as of `estimates`.

    ``seed`` draws the readings that are withheld. Estimates are kept at the steps ``kept``, by
    default all.
    """
    loaded = load_method(method, "estimation")
    if "filter" not in loaded.boards:
        raise ValueError("method must say a state after each reading, as on filter boards, got "
                         f"{loaded.name} of {', '.join(loaded.boards)} boards")
    if not loaded.suits(env.task):
        raise ValueError(f"method must suit a record of which the target {_motion(env.task)}, got "
                         f"{loaded.name}")
    T = env.episode_steps
    wanted = set(range(1, T + 1) if kept is None else np.asarray(kept).tolist())
    missed, nis = np.full(T, np.nan), np.full(T, np.nan)
    asked = env.task.velocity
    velocity = None if asked is None else np.tile(asked.nominal, (T, 1))
    said: dict[int, Estimate] = {}
    with threadpool_limits(1):
        for now, estimate in _shown(env, estimates(env, loaded, seed), loaded.name):
            nis[now - 1] = _nis(env, now, estimate)
            if velocity is not None and estimate.velocity is not None:
                velocity[now - 1] = estimate.velocity
            for t in env.judged_by(now):
                off = env.missed(t, np.asarray(estimate.mean))
                if len(off):
                    missed[t - 1] = np.sqrt(np.mean(off**2))
            if now in wanted:
                said[now] = estimate._replace(innovation=None, innovation_covariance=None)
    return Played(loaded.name, np.array(list(said)), np.array([e.mean for e in said.values()]),
                  _variance(list(said.values())), nis, missed, velocity)


def _motion(task: Task) -> str:
    if isinstance(task.transport, AtRest):
        return "stands still"
    if isinstance(task.transport, RandomWalk):
        return "walks at random"
    known = "is known" if task.velocity is None else "is asked for"
    return f"is carried by a flow that {known}"


def pages_steps(env: MeasuredEnv) -> np.ndarray:
    """Of which estimates `electrode_misfits` and the pictures of a page are made: the record's
    first and last, and those of some frames."""
    frame = env.record.frame
    begins = _begins(env, COLUMNS)
    steps = begins[:, None] + np.arange(frame + 1)
    return np.unique(np.clip([1, env.episode_steps, *steps.ravel()], 1, env.episode_steps))


def _begins(env: MeasuredEnv, most: int) -> np.ndarray:
    """First readings, 0, 1, …, of at most so many frames, evenly over the record."""
    begins = np.arange(0, max(env.episode_steps - env.record.frame, 0) + 1, env.record.frame)
    evenly = np.linspace(0, len(begins) - 1, most).round().astype(int)
    chosen: np.ndarray = begins[np.unique(evenly)]
    return chosen


def electrode_misfits(env: MeasuredEnv, played: Played,
                      most: int = COLUMNS) -> tuple[np.ndarray, np.ndarray]:
    """How well each electrode does over time, of at most so many frames, evenly over the record.

    Returns
    -------
    times : (C,)
        s at which these frames begin.
    misfits : (C, L)
        Root mean square of what the readings of a frame in which an electrode takes part are off
        the estimate before them, in standard deviations of the noise; of a target at rest off the
        last estimate. Only readings while it carries current, if there are any: they tell of its
        contact, which the next estimate takes for a change of what is before it. NaN without any.
    """
    record = env.record
    frame = record.frame
    begins = _begins(env, most)
    at_rest = isinstance(env.task.transport, AtRest)
    takes_part = record.matrix != 0.0
    carries = record.currents != 0.0
    # (K, M, L) bool
    tells = env.there[..., None] & takes_part & carries[:, None, :]
    if not tells.any():
        tells = env.there[..., None] & takes_part
    misfits = np.full((len(begins), record.currents.shape[1]), np.nan)
    for misfit, begin in zip(misfits, begins, strict=True):
        squares, count = np.zeros(len(misfit)), np.zeros(len(misfit))
        for t in range(begin, begin + frame):
            row = -1 if at_rest else played.at(max(t, 1))
            off = env.off(t + 1, played.mean[row])
            tell = tells[record.injections[t]]
            squares += np.nan_to_num(off)**2 @ tell
            count += tell.sum(axis=0)
        some = count > 0
        misfit[some] = np.sqrt(squares[some] / count[some])
    return record.times[begins], misfits


def _shown(env: MeasuredEnv, steps: Iterator[tuple[int, Estimate]],
           name: str) -> Iterator[tuple[int, Estimate]]:
    return iter(tqdm(steps, total=env.episode_steps, desc=name, unit="reading", disable=None,
                     leave=False))


def _variance(said: list[Estimate]) -> np.ndarray | None:
    if not said or said[-1].variance is None:
        return None
    none = np.full(len(said[-1].mean), np.nan)
    return np.array([none if each.variance is None else each.variance for each in said])


def _nis(env: MeasuredEnv, t: int, estimate: Estimate) -> float:
    """What is not shown has an innovation of 0 and leaves the sum as it is."""
    if estimate.innovation is None or estimate.innovation_covariance is None:
        return float("nan")
    model = env.task.observation
    assert isinstance(model, ReadingModel)
    whitened = np.linalg.solve(estimate.innovation_covariance, estimate.innovation)
    many = int(model.seen[env.record.injections[t - 1]].sum())
    return float(estimate.innovation @ whitened) / many if many else float("nan")
