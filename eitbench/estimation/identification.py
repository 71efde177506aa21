"""Learning a pipe's model from training episodes (``docs/methods.md``, 12)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from eitbench import _check
from eitbench.data.learning.examples import Dataset, Example
from eitbench.data.seeds import SPLITS, name_seed
from eitbench.estimation.identified import IdentifiedModel, told
from eitbench.estimation.inflow_response import steady_response
from eitbench.worlds.task import Task, make_task
from eitbench.worlds.world import World

KEPT = 1e-4
"""Modes across the inlet of less than this part of the inflow's variance are left out."""
RIDGE = 1e-6
"""of the mean square of what an inflow is known by: keeps apart what never came apart."""
EVERY = 3
"""Voltages are compared at each third step only: neighbours say much the same, and three turns pass
all injections of a cycle that is no multiple of it."""


class Moments(NamedTuple):
    """Sums over all states of training episodes, s being past inflows and d = c/c_0 − 1."""

    states: int
    inflow: np.ndarray
    """(K·r, K·r) Σ s sᵀ"""
    cross: np.ndarray
    """(K·r, n) Σ s dᵀ"""
    state: np.ndarray
    """(n, n) Σ d dᵀ"""
    bias: np.ndarray
    """(P, L) mean error of readings, in standard deviations of their noise"""


def identified_model(examples: Dataset, *, modes: int = 64, progress: Any = iter,
                     source: Mapping[str, Any] | None = None) -> IdentifiedModel:
    """What an inflow leaves in the pipe, by ridge regression of the true states on the inflows
    before them; and by how much that, and the voltages that the task's model computes, are off.

    A state's deviation is linear in the inflows of the past, whatever the flow is, as long as it is
    always the same. The concentration is told in the strongest modes of the training states.

    Parameters
    ----------
    examples : Dataset
        Episodes of the split train.
    modes : int
        q.
    progress : callable
        Wraps the iteration over the examples; such as ``tqdm``.
    source
        As in `IdentifiedModel`.

    Raises
    ------
    ValueError
        If an episode is of another split, the world has no inflow, or there are more modes than
        states to learn from.
    """
    if others := [seed for seed in examples.seeds if seed not in SPLITS["train"]]:
        raise ValueError("examples' seeds must be of the split train, from which alone is learned; "
                         f"got {name_seed(others[0])}")
    world = examples.world
    q = _check.integer("modes", modes, low=1, high=examples.mesh.n_nodes)
    if len(examples) * world.n_steps <= q:
        raise ValueError(f"examples must have more states than modes, {q}; got "
                         f"{len(examples) * world.n_steps}")
    task = make_task(world)
    across = _across(world, examples.seeds)
    memory = steady_response(task.transport).weights.shape[1]
    moments = _moments(progress(examples), world, task, across, memory)
    mass = examples.mass.toarray()
    root = np.linalg.cholesky(mass)
    _, vectors = np.linalg.eigh(root.T @ moments.state @ root)
    basis = np.linalg.solve(root.T, vectors[:, :-q - 1:-1])
    cross = moments.cross @ (mass @ basis)
    size = len(moments.inflow)
    ridge = RIDGE * np.trace(moments.inflow) / size
    ridged = moments.inflow + ridge * np.eye(size)
    weights = np.linalg.solve(ridged, cross)
    free = moments.states - np.trace(np.linalg.solve(ridged, moments.inflow))
    explained = weights.T @ cross
    left = (basis.T @ mass @ moments.state @ mass @ basis - explained - explained.T
            + weights.T @ moments.inflow @ weights)
    return IdentifiedModel(basis, weights.T.reshape(q, memory, -1), across,
                           0.5 * (left + left.T) / free, task.currents, moments.bias,
                           told(task), world.background, source or {})


def _across(world: World, seeds: Iterable[int]) -> np.ndarray:
    """(n_inlet, r) orthonormal: the strongest modes of the inflow across the inlet."""
    s = np.concatenate([world.sample_inflow(seed) for seed in seeds]) / world.background - 1.0
    values, vectors = np.linalg.eigh(s.T @ s)
    return vectors[:, values > KEPT * values.sum()][:, ::-1]


def _moments(examples: Iterable[Example], world: World, task: Task, across: np.ndarray,
             memory: int) -> Moments:
    n = task.mesh.n_nodes
    size = memory * across.shape[1]
    count = 0
    inflow, cross, state = np.zeros((size, size)), np.zeros((size, n)), np.zeros((n, n))
    cycle = task.currents
    off = np.zeros((len(cycle), cycle.shape[1]))
    compared = np.zeros(len(cycle))
    for example in examples:
        s = recent_inflows(world.sample_inflow(example.seed) / world.background - 1.0, across,
                           len(example.truth), memory)
        d = example.truth / world.background - 1.0
        inflow += s.T @ s
        cross += s.T @ d
        state += d.T @ d
        count += len(d)
        for t in range(0, len(d), EVERY):
            computed = task.observation.voltages(example.truth[t].astype(float),
                                                 example.currents[t:t + 1])[0]
            pattern = t % len(cycle)
            off[pattern] += (example.voltages[t] - computed) / task.noise.std(computed)
            compared[pattern] += 1
    return Moments(count, inflow, cross, state, off / np.maximum(compared, 1)[:, None])


def recent_inflows(s: np.ndarray, across: np.ndarray, steps: int, memory: int) -> np.ndarray:
    """(T, K·r) of each of the last T states: its K last inflows, in modes; nothing deviates before
    the record of inflows (·, n_inlet) begins."""
    reduced = s @ across
    longer = np.concatenate([np.zeros((memory, reduced.shape[1])), reduced])
    newest = len(longer) - steps + np.arange(steps)
    past = longer[newest[:, None] - np.arange(memory)]
    return past.reshape(steps, -1)
