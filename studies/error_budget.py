"""Error budget of the best filter: `python studies/error_budget.py`, some minutes.

On Pipe2D, dev:0-15, the log-inflow filter with the identified flow runs on true episodes, and on
episodes in which one assumption after the other holds: states and voltages of its model, inflows
from its prior, a tenth of the noise, all injections at every step, the best pair alone. The table
has ẽ_c, its prediction by the filter, and the fraction of it within 5 cm of the inlet.
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
EPISODES = "dev:0-15"
BASELINES = Path(__file__).parents[1] / "baselines"
BEST_PAIR = (0, 8)
"""Pair of `baselines/injection/best_pair.py`."""
INLET_REGION_M = 0.05
LOW_NOISE_FACTOR = 0.1

Injections = Callable[[int], np.ndarray]
"""t = 1, 2, … -> currents (J, L) of the measurements of state t."""


class EpisodeErrors(NamedTuple):
    """Means over the scored states of one episode."""

    error: float
    """ẽ_c"""
    predicted: float
    """ẽ_c predicted by the variance of the filter"""
    near: float
    """fraction of the squared error within `INLET_REGION_M` of the inlet"""


class ErrorBudget:
    """Filter, and simulated episodes in which its assumptions hold."""

    def __init__(self) -> None:
        self.examples = eitbench.dataset(ID, EPISODES)
        self.task = make_task(self.examples.world)
        self.prior = compatible_priors(BASELINES / "priors", self.task, "logarithm")[0]
        self.model = compatible_models(BASELINES / "models", self.task)[0]
        self.mass = self.examples.mass
        x = self.task.mesh.points[:, 0]
        self.near = x < x.min() + INLET_REGION_M

    # -- episodes --------------------------------------------------------------------------------

    def model_states(self, seed: int, from_prior: bool) -> np.ndarray:
        """Return the model's states (T, n) in mol/m³ for the inflow of the episode, or for an
        inflow sampled from the prior."""
        task = self.task
        world = self.examples.world
        if from_prior:
            steps = world.spin_up_steps + task.n_steps + 1
            correlation = self.prior.time_covariance(steps)
            lags = np.abs(np.subtract.outer(np.arange(steps), np.arange(steps)))
            x = np.linalg.cholesky(correlation[lags]) @ episode_streams(seed).policy.normal(
                size=(steps, self.prior.modes.shape[1]))
            inflow = self.prior.inverse_link(x @ self.prior.modes.T)
        else:
            inflow = world.sample_inflow(seed) / world.background
        basis, weights = self.model.response
        n_lags = weights.shape[1]
        deviation = np.concatenate([np.zeros((n_lags, inflow.shape[1])), inflow - 1.0])
        newest = len(deviation) - task.n_steps + np.arange(task.n_steps)
        past = deviation[newest[:, None] - np.arange(n_lags)]
        reduced = np.tensordot(past, weights, ((1, 2), (1, 2)))
        state: np.ndarray = world.background * (1.0 + reduced @ basis.T)
        return state

    def measure(self, states: np.ndarray, injections: Injections, noise: VoltageNoise,
                seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Simulate voltages and currents (J, L) of each state with the model of the filter."""
        random = episode_streams(seed).noise
        measurements = []
        for t, state in enumerate(states, start=1):
            currents = injections(t)
            voltages = self.task.observation.voltages(state, currents)
            error = noise.std(voltages) * random.normal(size=voltages.shape)
            measurements.append((voltages + error, currents))
        return measurements

    def cycle(self, t: int) -> np.ndarray:
        """Return the injection of the world's cycle."""
        currents = self.task.currents
        return currents[(t - 1) % len(currents)][None]

    def all_injections(self, t: int) -> np.ndarray:
        """Return all injections of the cycle."""
        return self.task.currents

    def pair(self, t: int) -> np.ndarray:
        """Return the cycle in the first frame, which determines ĉ_bh, then the best pair."""
        if t <= self.task.calibration:
            return self.cycle(t)
        currents = np.zeros((1, self.task.currents.shape[1]))
        currents[0, BEST_PAIR] = np.abs(self.task.currents).max() * np.array([1.0, -1.0])
        return currents

    # -- the filter ------------------------------------------------------------------------------

    def run_filter(self, measurements: list[tuple[np.ndarray, np.ndarray]], noise: VoltageNoise, *,
                   exact: bool, iterated: bool = True) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield mean and variance (n,) of each state; with an ``exact`` model, measurement noise is
        the only error."""
        task = replace(self.task, noise=noise)
        first = measurements[:task.calibration]
        c_ref = best_homogeneous(task.observation, noise,
                                 np.concatenate([voltages for voltages, _ in first]),
                                 np.concatenate([currents for _, currents in first]),
                                 task.expected_concentration)
        model = {"responses": [self.model.response]} if exact else {"model": self.model}
        filter_ = inflow_filter(task, self.prior, c_ref, iterated=iterated, **model)
        for voltages, currents in measurements:
            if len(currents) == 1:
                filter_.assimilate(voltages[0], currents[0])
            else:
                filter_.predict()
                point = filter_.concentration
                predicted, jacobian = task.observation.linearise(point, currents)
                matrix = jacobian.reshape(-1, jacobian.shape[-1])
                value = (voltages - predicted).ravel() + matrix @ point
                filter_.update(LinearMeasurement(matrix, value, noise.std(predicted).ravel()**2))
            yield filter_.concentration, filter_.variance

    def score(self, estimates: Iterator[tuple[np.ndarray, np.ndarray]], truth: np.ndarray,
              unresolved: np.ndarray, square: np.ndarray) -> EpisodeErrors:
        """Return the means over the scored states."""
        mean, variance = (np.array(part) for part in zip(*estimates, strict=True))
        scored = slice(self.task.warm_up, None)
        lumped = np.asarray(self.mass.sum(axis=0)).ravel()
        squares = (mean - truth)**2 * lumped
        exact = np.einsum("tn,nt->t", mean - truth, self.mass @ (mean - truth).T) + unresolved
        return EpisodeErrors(float((exact / square)[scored].mean()),
                             float(((variance @ lumped) / square)[scored].mean()),
                             float(squares[scored][:, self.near].sum() / squares[scored].sum()))

    def run_true_episode(self, example: Example, iterated: bool = True) -> EpisodeErrors:
        """Run the filter on an episode of the environment."""
        measurements = [(voltages[None], currents[None]) for voltages, currents
                        in zip(example.voltages, example.currents, strict=True)]
        estimates = self.run_filter(measurements, self.task.noise, exact=False, iterated=iterated)
        return self.score(estimates, example.truth, example.unresolved, example.square)

    def run_model_episode(self, seed: int, injections: Injections, *, from_prior: bool = False,
                          noise_factor: float = 1.0) -> EpisodeErrors:
        """Run the filter on an episode of its model."""
        noise = VoltageNoise(noise_factor * self.task.noise.relative,
                             noise_factor * self.task.noise.relative_to_max)
        states = self.model_states(seed, from_prior)
        measurements = self.measure(states, injections, noise, seed)
        square = np.einsum("tn,nt->t", states, self.mass @ states.T)
        return self.score(self.run_filter(measurements, noise, exact=True), states,
                          np.zeros(len(states)), square)


def main() -> None:
    budget = ErrorBudget()
    seeds = parse_seeds(EPISODES)
    true, model = budget.run_true_episode, budget.run_model_episode
    rows: dict[str, Callable[[int], EpisodeErrors]] = {
        "true episodes": lambda k: true(budget.examples[k]),
        "true episodes, each measurement linearised once, not twice":
            lambda k: true(budget.examples[k], iterated=False),
        "model episodes: flow, mesh and voltages as assumed, with the inflow of the true episodes":
            lambda k: model(seeds[k], budget.cycle),
        "model episodes, with the inflow drawn from the prior":
            lambda k: model(seeds[k], budget.cycle, from_prior=True),
        "model episodes, a tenth of the noise":
            lambda k: model(seeds[k], budget.cycle, noise_factor=LOW_NOISE_FACTOR),
        "model episodes, all 16 injections at every step":
            lambda k: model(seeds[k], budget.all_injections),
        "model episodes, a tenth of the noise and all 16 injections at every step":
            lambda k: model(seeds[k], budget.all_injections, noise_factor=LOW_NOISE_FACTOR),
        f"model episodes, only the pair {BEST_PAIR} after the first frame":
            lambda k: model(seeds[k], budget.pair)}
    print("| | ẽ_c | ẽ_c predicted by the filter | fraction of ẽ_c within 5 cm of the inlet |\n"
          "|---|---:|---:|---:|")
    for title, run in rows.items():
        with threadpool_limits(1):
            errors = [run(k) for k in tqdm(range(len(seeds)), desc=title, leave=False,
                                           disable=None)]
        error, predicted, near = np.mean(errors, axis=0)
        print(f"| {title} | {error:.5f} | {predicted:.5f} | {near:.0%} |", flush=True)


if __name__ == "__main__":
    main()
