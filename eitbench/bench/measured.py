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
from eitbench.physics.rest import AtRest

if TYPE_CHECKING:
    from eitbench.envs.measured import MeasuredEnv
    from eitbench.worlds.task import Estimate


COLUMNS = 60
"""frames at which electrodes are looked at, at most"""


@dataclass(frozen=True, eq=False)
class Played:
    """What a method says of a record, t = 1 … T."""

    method: str
    mean: np.ndarray
    """(T, n) mol/m³ at the nodes of the task's mesh"""
    variance: np.ndarray | None
    """(T, n) (mol/m³)², if the method says it of each state after the first frame; NaN within"""
    nis: np.ndarray
    """(T,) νᵀS⁻¹ν in parts of the readings shown; NaN where a method says none"""
    missed: np.ndarray
    """(T,) root mean square of the withheld readings' distance from what the estimate that they
    judge predicts, in standard deviations of the noise; NaN where nothing is judged"""

    def save(self, path: Path, env: MeasuredEnv) -> None:
        """Write what is said as npz, whole or not at all: ``mean`` and ``variance`` (T, n), ``nis``
        and ``missed`` (T,), ``times`` (T,) in s, and the mesh's ``points`` (n, d) in m and
        ``cells``."""
        content = io.BytesIO()
        mesh = env.task.mesh
        said: dict[str, Any] = {
            "mean": self.mean, "nis": self.nis, "missed": self.missed, "times": env.record.times,
            "points": mesh.points, "cells": mesh.cells}
        if self.variance is not None:
            said["variance"] = self.variance
        np.savez_compressed(content, **said)
        write_atomically(path, content.getvalue())

    @property
    def withheld(self) -> float:
        """Root mean square of `missed`: 1 is as good as the noise lets one be."""
        return float(np.sqrt(np.nanmean(self.missed**2)))


def play_record(env: MeasuredEnv, method: str, seed: int = 0) -> Played:
    """Play one of our methods, or the one of a path, on a record; errors as of `estimates`.

    ``seed`` draws the readings that are withheld.
    """
    loaded = load_method(method, "estimation")
    if not loaded.suits(env.task):
        moves = "stands still" if isinstance(env.task.transport, AtRest) else "walks at random"
        raise ValueError(f"method must suit a record of which the target {moves}, got "
                         f"{loaded.name}")
    with threadpool_limits(1):
        said = [estimate for _, estimate in _shown(env, estimates(env, loaded, seed), loaded.name)]
    T = len(said)
    missed = np.full(T, np.nan)
    for last, judged in env.judged.items():
        for t in judged:
            off = env.missed(t, np.asarray(said[last - 1].mean))
            if len(off):
                missed[t - 1] = np.sqrt(np.mean(off**2))
    return Played(loaded.name, np.array([each.mean for each in said]), _variance(said),
                  np.array([_nis(env, t, each) for t, each in enumerate(said, 1)]), missed)


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
    begins = np.arange(0, len(played.mean) - frame + 1, frame)
    begins = begins[np.unique(np.linspace(0, len(begins) - 1, most).round().astype(int))]
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
            off = env.off(t + 1, played.mean[-1 if at_rest else max(t - 1, 0)])
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
    if said[-1].variance is None:
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
