"""Full filters of the episodes of an injection environment, for scored runs, and the choice among
all filters."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from eitbench import _check
from eitbench.estimation.filter import Filter, StateSpace, Step
from eitbench.estimation.gaussian import LinearMeasurement, innovate
from eitbench.estimation.inflow_window import InflowWindow
from eitbench.estimation.nodal import nodal_states
from eitbench.estimation.onboard.body_filters import BodyFilters, FullBodyFilters
from eitbench.estimation.onboard.electrode_faults import ElectrodeFaults
from eitbench.estimation.onboard.episode_filters import EpisodeFilters, Innovation
from eitbench.estimation.onboard.inflow_states import fit_world_prior
from eitbench.estimation.onboard.linearisation import linearisation_table, std_from_variance
from eitbench.estimation.onboard.models import VELOCITY_BOUNDS
from eitbench.estimation.onboard.reduced_filters import ReducedFilters
from eitbench.estimation.onboard.rules import Rules
from eitbench.estimation.velocity import VelocityStates, task_velocity_prior
from eitbench.worlds.world import World

ESTIMATOR_OPTIONS = ("reduced", "full", "none")
"""Reduced filter for training, full filter for scores, or no filter."""


class FullFilters(EpisodeFilters):
    """Filters of the built-in methods for B episodes; the state is relative to c_ref.

    With a white inflow, voltages are linearised about c_ref of the first frame, and an unknown
    velocity is part of the state. With a learned inflow, they are linearised about each prediction.
    """

    def _start(self, episodes: int) -> None:
        rules = self._rules
        space = state_space(rules.world.fault_free, rules.inflow)
        self._filters = [Filter(space, gate=rules.gate) for _ in range(episodes)]
        self._last: list[Step | None] = [None] * episodes

    def _condition(self, voltages: np.ndarray,
                   currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        innovations = np.zeros_like(voltages)
        accepted = np.ones(voltages.shape, dtype=bool)
        self._last = [None] * len(voltages)
        measurements: dict[int, LinearMeasurement] = {}
        for b, filter_ in enumerate(self._filters):
            filter_.predict()
            if currents[b].any():
                measurements[b] = self._measurement(b, voltages[b], currents[b])
        if self.faults is not None:
            innovations = self._weigh(self.faults, measurements, voltages, currents)
        for b, measurement in measurements.items():
            step = self._filters[b].update(measurement)
            self._last[b] = step
            accepted[b] = step.accepted
            if self.faults is None:
                innovations[b] = step.innovation
            innovations[b] /= np.sqrt(step.innovation_covariance.diagonal())
        return innovations, accepted

    def _weigh(self, faults: ElectrodeFaults, measurements: dict[int, LinearMeasurement],
               voltages: np.ndarray, currents: np.ndarray) -> np.ndarray:
        """Update the ``faults``, set values of ``measurements`` to NaN where they are rejected and
        their noise to the noise of the faults; return all innovations (B, L) in V."""
        B, L = voltages.shape
        innovation, noise = np.zeros((B, L)), np.ones((B, L))
        signal = np.zeros((B, L, L))
        for b, measurement in measurements.items():
            filter_ = self._filters[b]
            H = filter_.space.jacobian(filter_.mean, measurement.matrix)
            residual = measurement.value - measurement.matrix @ filter_.concentration
            innovation[b], signal[b], _ = innovate(filter_.covariance, H, residual, np.zeros(L))
            noise[b] = measurement.noise_variance
        used, noise = faults.weigh(voltages, innovation, signal, noise, currents)
        for b, each in measurements.items():
            value = np.where(np.isnan(used[b]), np.nan, each.value)
            measurements[b] = each._replace(value=value, noise_variance=noise[b])
        return innovation

    def _measurement(self, b: int, voltages: np.ndarray, currents: np.ndarray) -> LinearMeasurement:
        """Return the measurement (L,) of the relative concentration (n,) of an episode."""
        c_ref = self.c_ref[b]
        if self._rules.inflow == "white":
            linearisation = self.table.linearisation(self.indices[b])
            computed = currents @ linearisation.resistance
            matrix = linearisation.by_state(currents)
            about = np.ones(matrix.shape[1])
        else:
            about = self._filters[b].concentration
            (computed,), (by_c,) = self.table.task.observation.linearise(c_ref * about,
                                                                          currents[None])
            matrix = c_ref * by_c
        std = self.table.noise_std(computed, self._rules.instrument.noise_floor)
        return LinearMeasurement(matrix, voltages - computed + matrix @ about, std**2)

    def innovations(self) -> list[Innovation | None]:
        return [None if step is None else
                Innovation.of(step.innovation, step.innovation_covariance, step.accepted)
                for step in self._last]

    def coarse_grid(self) -> tuple[np.ndarray, np.ndarray]:
        # One product per episode: the bits of a joint product depend on the number of episodes.
        averages = self.table.grid_averages
        mean = (averages @ self.means()[..., None])[..., 0]
        variance = np.array([each.covariance.variance_of(each.space.jacobian(each.mean, averages))
                             for each in self._filters])
        return mean, self.c_ref[:, None] * std_from_variance(variance)

    def means(self) -> np.ndarray:
        return self.c_ref[:, None] * np.array([each.concentration for each in self._filters])

    def stds(self) -> np.ndarray:
        variance = np.array([each.variance for each in self._filters])
        return self.c_ref[:, None] * std_from_variance(variance)

    def velocity(self) -> tuple[np.ndarray, np.ndarray] | None:
        velocities = [each.space.velocity(each.mean, each.covariance) for each in self._filters]
        if None in velocities:
            return None
        theta, variance = (np.array(part) for part in zip(*velocities, strict=True))
        return theta, std_from_variance(variance)


@lru_cache(maxsize=4)
def state_space(world: World, inflow: str) -> StateSpace:
    """Return the state space of all episodes of a world, for concentrations relative to c_ref."""
    task: Any = linearisation_table(world).task
    if inflow == "learned":
        return InflowWindow(task, fit_world_prior(world), 1.0)
    if task.velocity is None:
        return nodal_states(task.transport, task.prior, 1.0)
    return VelocityStates(task, 1.0, task_velocity_prior(task, VELOCITY_BOUNDS))


def filters_class(rules: Rules, estimator: str) -> type[EpisodeFilters] | None:
    """Return the filters' class for one of `ESTIMATOR_OPTIONS`, None for "none". ``ValueError`` for
    another option, or if the rules have a learned inflow, estimated faults or few readings that the
    world does not permit."""
    _check.choice("estimator", estimator, ESTIMATOR_OPTIONS)
    if estimator == "none":
        return None
    if rules.faults == "estimated" and (rules.instrument.max_faulty == 0 or rules.tracks_body):
        raise ValueError("faults must be 'gate' for an instrument without faults and for a body, "
                         "got 'estimated'")
    if rules.inflow == "learned":
        if not hasattr(rules.world.target, "draw_inflow"):
            raise ValueError("inflow must be 'white' for a target without inflow, got 'learned' "
                             f"for the target {type(rules.world.target).__name__}")
        if rules.world.velocity_model is not None:
            raise ValueError("inflow must be 'white' where the velocity is estimated too, "
                             f"got {rules.inflow!r}")
    if rules.instrument.readings != "all" and not rules.tracks_body:
        raise ValueError("readings must be 'all' in an injection environment without a moving "
                         f"body, got {rules.instrument.readings!r}")
    if rules.tracks_body:
        return BodyFilters if estimator == "reduced" else FullBodyFilters
    return ReducedFilters if estimator == "reduced" else FullFilters
