"""What the error of the best filter is made of: `python studies/error_budget.py`, some minutes.

On Pipe2D, dev:0-15, the filter of the inflow's logarithm and the identified flow plays true
episodes, then such in which one thing after the other is as it believes: states and voltages of its
own model, inflows of its own prior, ten times less noise, all injections at every step, the best
pair alone. Printed are ẽ_c, what the filter itself expects of it, and how much of it lies within
5 cm of the inlet.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits
from tqdm import tqdm

import eitbench
from eitbench.data.dataset import Example
from eitbench.data.seeds import parse_seeds
from eitbench.estimation import (
    LinearMeasurement,
    best_homogeneous,
    compatible_models,
    compatible_priors,
    inflow_filter,
)
from eitbench.physics.observation import VoltageNoise
from eitbench.worlds.random_streams import episode_streams
from eitbench.worlds.task import make_task

ID = "eitbench/Pipe2D-v0"
PLAYED = "dev:0-15"
BASELINES = Path(__file__).parents[1] / "baselines"
BEST_PAIR = (0, 8)
"""of `baselines/injection/best_pair.py`"""
NEAR = 0.05
"""m from the inlet"""
QUIET = 0.1
"""of the noise"""

Injections = Callable[[int], np.ndarray]
"""t = 1, 2, … → (J, L) currents under which the state t is measured"""


class Played(NamedTuple):
    """Means over the scored states of one episode."""

    error: float
    """ẽ_c"""
    claimed: float
    """of the filter's variance over c², as ẽ_c"""
    near: float
    """part of the squared error that lies within `NEAR` of the inlet"""


class Budget:
    """The filter, and the worlds in which it plays."""

    def __init__(self) -> None:
        self.examples = eitbench.dataset(ID, PLAYED)
        self.task = make_task(self.examples.world)
        self.prior = compatible_priors(BASELINES / "priors", self.task, "logarithm")[0]
        self.model = compatible_models(BASELINES / "models", self.task)[0]
        self.mass = self.examples.mass
        x = self.task.mesh.points[:, 0]
        self.near = x < x.min() + NEAR

    # -- episodes --------------------------------------------------------------------------------

    def states(self, seed: int, drawn: bool) -> np.ndarray:
        """(T, n) mol/m³ as the model has it, of the episode's inflow, or of one drawn from the
        prior."""
        task = self.task
        world = self.examples.world
        if drawn:
            steps = world.spin_up_steps + task.n_steps + 1
            correlation = self.prior.time_covariance(steps)
            apart = np.abs(np.subtract.outer(np.arange(steps), np.arange(steps)))
            x = np.linalg.cholesky(correlation[apart]) @ episode_streams(seed).policy.normal(
                size=(steps, self.prior.modes.shape[1]))
            inflow = self.prior.inverse_link(x @ self.prior.modes.T)
        else:
            inflow = world.sample_inflow(seed) / world.background
        basis, weights = self.model.response
        memory = weights.shape[1]
        deviation = np.concatenate([np.zeros((memory, inflow.shape[1])), inflow - 1.0])
        newest = len(deviation) - task.n_steps + np.arange(task.n_steps)
        past = deviation[newest[:, None] - np.arange(memory)]
        reduced = np.tensordot(past, weights, ((1, 2), (1, 2)))
        state: np.ndarray = world.background * (1.0 + reduced @ basis.T)
        return state

    def measured(self, states: np.ndarray, injections: Injections, noise: VoltageNoise,
                 seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Voltages and currents (J, L) of each state, by the model that the filter has."""
        random = episode_streams(seed).noise
        record = []
        for t, state in enumerate(states, start=1):
            currents = injections(t)
            voltages = self.task.observation.voltages(state, currents)
            record.append((voltages + noise.std(voltages) * random.normal(size=voltages.shape),
                           currents))
        return record

    def cycle(self, t: int) -> np.ndarray:
        """As the world does it."""
        currents = self.task.currents
        return currents[(t - 1) % len(currents)][None]

    def all_at_once(self, t: int) -> np.ndarray:
        return self.task.currents

    def pair(self, t: int) -> np.ndarray:
        """The first frame as the world does it, from which the level is known; then one pair."""
        if t <= self.task.calibration:
            return self.cycle(t)
        currents = np.zeros((1, self.task.currents.shape[1]))
        currents[0, BEST_PAIR] = np.abs(self.task.currents).max() * np.array([1.0, -1.0])
        return currents

    # -- the filter ------------------------------------------------------------------------------

    def follow(self, record: list[tuple[np.ndarray, np.ndarray]], noise: VoltageNoise, *,
               own: bool, times: int = 2) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Mean and variance (n,) of each state; ``own``: nothing but the noise is off, ``times``:
        how often each measurement is linearised."""
        task = replace(self.task, noise=noise)
        first = record[:task.calibration]
        level = best_homogeneous(task.observation, noise, task.mesh.n_nodes,
                                 np.concatenate([voltages for voltages, _ in first]),
                                 np.concatenate([currents for _, currents in first]),
                                 task.expected_concentration)
        known = {"responses": [self.model.response]} if own else {"model": self.model}
        filter_ = inflow_filter(task, self.prior, level, iterated=times == 2, **known)
        for voltages, currents in record:
            if len(currents) == 1:
                filter_.assimilate(voltages[0], currents[0])
            else:
                filter_.predict()
                point = filter_.concentration
                computed, by_c = task.observation.linearise(point, currents)
                matrix = by_c.reshape(-1, by_c.shape[-1])
                value = (voltages - computed).ravel() + matrix @ point
                filter_.update(LinearMeasurement(matrix, value, noise.std(computed).ravel()**2))
            yield filter_.concentration, filter_.variance

    def score(self, estimates: Iterator[tuple[np.ndarray, np.ndarray]], truth: np.ndarray,
              unresolved: np.ndarray, square: np.ndarray) -> Played:
        mean, variance = (np.array(part) for part in zip(*estimates, strict=True))
        scored = slice(self.task.warm_up, None)
        lumped = np.asarray(self.mass.sum(axis=0)).ravel()
        off = (mean - truth)**2 * lumped
        exact = np.einsum("tn,nt->t", mean - truth, self.mass @ (mean - truth).T) + unresolved
        return Played(float((exact / square)[scored].mean()),
                      float(((variance @ lumped) / square)[scored].mean()),
                      float(off[scored][:, self.near].sum() / off[scored].sum()))

    def true(self, example: Example, times: int = 2) -> Played:
        record = [(voltages[None], currents[None])
                  for voltages, currents in zip(example.voltages, example.currents, strict=True)]
        return self.score(self.follow(record, self.task.noise, own=False, times=times),
                          example.truth, example.unresolved, example.square)

    def own(self, seed: int, injections: Injections, *, drawn: bool = False, noise: float = 1.0,
            times: int = 2) -> Played:
        """In the filter's own world, the noise so many times what it is."""
        told = VoltageNoise(noise * self.task.noise.relative,
                            noise * self.task.noise.relative_to_max)
        states = self.states(seed, drawn)
        record = self.measured(states, injections, told, seed)
        square = np.einsum("tn,nt->t", states, self.mass @ states.T)
        return self.score(self.follow(record, told, own=True, times=times), states,
                          np.zeros(len(states)), square)


def main() -> None:
    budget = Budget()
    rows: dict[str, Callable[[int], Played]] = {
        "true episodes": lambda k: budget.true(budget.examples[k]),
        "… each measurement linearised once":
            lambda k: budget.true(budget.examples[k], times=1),
        "flow, mesh and voltages as believed": lambda k: budget.own(k, budget.cycle),
        "… the inflow drawn from the prior too":
            lambda k: budget.own(k, budget.cycle, drawn=True),
        "… a tenth of the noise": lambda k: budget.own(k, budget.cycle, noise=QUIET),
        "… all 16 injections at every step": lambda k: budget.own(k, budget.all_at_once),
        "… both": lambda k: budget.own(k, budget.all_at_once, noise=QUIET),
        f"… only the pair {BEST_PAIR}, after the first frame":
            lambda k: budget.own(k, budget.pair)}
    seeds = parse_seeds(PLAYED)
    print("| | ẽ_c | expected | within 5 cm of the inlet |\n|---|---:|---:|---:|")
    for title, play in rows.items():
        known = title.startswith("true") or "linearised" in title
        with threadpool_limits(1):
            played = [play(k if known else seeds[k])
                      for k in tqdm(range(len(seeds)), desc=title, leave=False, disable=None)]
        error, claimed, near = np.mean(played, axis=0)
        print(f"| {title} | {error:.5f} | {claimed:.5f} | {near:.0%} |", flush=True)


if __name__ == "__main__":
    main()
