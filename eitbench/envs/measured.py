"""A record of a real instrument as an environment: ``eitbench/Measured-v0``."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from eitbench import _check
from eitbench.data.measured import Measurements, read
from eitbench.envs.estimation import RESET_NEEDED, EstimationEnv, Observation, checked_actions
from eitbench.envs.spec import KnowsItsLength
from eitbench.estimation.measured.calibration import calibrate, noise_of_frames
from eitbench.estimation.measured.plausible import doubts
from eitbench.estimation.measured.readings import ReadingModel
from eitbench.estimation.measured.record import (
    readings_there,
    shown_reading,
    withheld_readings,
)
from eitbench.estimation.measured.task import measured_task
from eitbench.estimation.measured.vessel import RealVessel, read_vessel
from eitbench.physics.rest import AtRest

if TYPE_CHECKING:
    from eitbench.worlds.task import Task

FIRST_GUESS = 1e-4
"""Ω·m², of the contact impedances."""
NOISE_FRAMES = 1000
"""The first so many frames tell the noise."""


class MeasuredEnv(KnowsItsLength, gym.Env[Observation, np.ndarray]):  # type: ignore[misc]
    """Estimate what a record of a real instrument saw; the action is the estimate.

    Nobody knows the truth, so an estimate is judged by readings that its maker was not shown: the
    reward is −mean ((reading − predicted)/std)² over the readings withheld of the injection that
    was on, zero in the first frame; of a target at rest the last estimate is judged, by all that
    was withheld. Which they are is drawn by the seed: of each injection a part,
    the same whenever it comes again. Observations are as in `EstimationEnv`, except that voltages
    are what the instrument read, (M,), and 0 where it read nothing or nothing is shown; the task's
    `ReadingModel` knows which.

    Parameters
    ----------
    file : path or Measurements
        What `eitbench.data.measured.read` reads.
    vessel : path, mapping or RealVessel
        What `read_vessel` reads.
    withheld : float
        Part of an injection's readings, from 0 to 0.5.
    moves : bool, optional
        Whether the target moves. Default: if there are two whole frames or more, or the vessel
        has a flow.
    correction : "offset" or "gain"
        See `calibrate`.
    homogeneous_frames : int
        Where a record has no reference, so many of its first frames are taken for homogeneous.
    believed
        What else is believed of the target; arguments of `measured_task`.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (gymnasium's form)

    def __init__(self, file: Path | str | Measurements,
                 vessel: Path | str | Mapping[str, Any] | RealVessel, *, withheld: float = 0.1,
                 moves: bool | None = None, correction: str = "offset",
                 homogeneous_frames: int = 1, **believed: Any) -> None:
        self.record = file if isinstance(file, Measurements) else read(file)
        self.vessel = vessel if isinstance(vessel, RealVessel) else read_vessel(vessel)
        record = self.record
        n_electrodes = record.currents.shape[1]
        if n_electrodes != self.vessel.n_electrodes:
            raise ValueError(f"vessel must have the record's {n_electrodes} electrodes, got "
                             f"{self.vessel.n_electrodes}")
        self.part = _check.number("withheld", withheld, low=0.0, high=0.5)
        homogeneous = record.homogeneous(homogeneous_frames)
        self.calibration = calibrate(
            self.vessel.electrode_model(FIRST_GUESS), record.currents, record.matrix,
            homogeneous, depth=self.vessel.depth,
            conductivity=self.vessel.conductivity, correction=correction,
            noise=None if len(homogeneous) > 1 else noise_of_frames(record.frames(NOISE_FRAMES)))
        if moves is None:
            flows = self.vessel.flow is not None
            moves = flows or len(record.readings) >= 2 * record.frame
        believed = {"moves": moves, **believed}
        self.there = readings_there(record)
        """(K, M) bool: readings that are there whenever an injection is."""
        self.episode_steps = len(record.injections)
        self.spread: np.ndarray | None = None
        """(n,) standard deviation in mol/m³ of the last estimate, for whoever has one."""
        self._believed = believed
        self._task_of = lru_cache(maxsize=1)(self._make_task)
        self._show(0)
        n = self.task.mesh.n_nodes
        voltage = 100.0 * record.largest
        current = float(np.abs(record.currents).max())
        M, L = record.matrix.shape
        self.observation_space: spaces.Dict = spaces.Dict({  # type: ignore[assignment]
            "voltages": spaces.Box(-voltage, voltage, (M,), np.float64),
            "currents": spaces.Box(-current, current, (L,), np.float64)})
        limit = np.full(n, 1e4 * self.task.expected_concentration)
        if self.task.velocity is not None:
            limit = np.append(limit, 1e2 * np.abs(self.task.velocity.nominal))
        self.action_space: spaces.Box = spaces.Box(-limit, limit, dtype=np.float64)
        self._step = 0

    def _make_task(self, seed: int) -> Task:
        hidden = withheld_readings(self.there, self.part, seed)
        return measured_task(self.vessel, self.calibration, self.record,
                             seen=self.there & ~hidden, **self._believed)

    def _show(self, seed: int) -> None:
        self.task: Task = self._task_of(seed)
        """What the agent may know."""
        model = self.task.observation
        assert isinstance(model, ReadingModel)
        self.hidden = self.there & ~model.seen
        """(K, M) bool: readings that the agent is not shown."""
        self._judge = model.showing(self.there)

    def reset(self, *, seed: int | None = None,
              options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Begin the record; the seed says which readings are withheld, by default 0."""
        super().reset(seed=seed)
        self._show(seed or 0)
        self._step = 1
        self.spread = None
        return self._observe(), {"step": 1}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Take the estimate (n,) in mol/m³ of the state in which the last readings were taken, and
        after it the flow's parameters in m/s if the vessel's flow is asked for."""
        if not 1 <= self._step <= self.episode_steps:
            raise gym.error.ResetNeeded(RESET_NEEDED)
        n = self.task.mesh.n_nodes
        estimate = checked_actions(action, self.action_space, n)[:n]
        reward = 0.0
        if judged := self.judged_by(self._step):
            off = np.concatenate([self.missed(t, estimate) for t in judged])
            reward = -float(np.mean(off**2)) if len(off) else 0.0
        self._step += 1
        return (self._observe(), reward, self._step > self.episode_steps, False,
                {"step": self._step})

    def doubts(self) -> list[str]:
        """What is odd about the record; see `eitbench.estimation.measured.plausible.doubts`."""
        return doubts(self.record, self.calibration, self.vessel.electrode_model(FIRST_GUESS))

    def judged_by(self, t: int) -> range:
        """By the withheld readings of which injections 1 … T an estimate at t is judged."""
        T = self.episode_steps
        if isinstance(self.task.transport, AtRest):
            return range(1, T + 1) if t == T else range(0)
        return range(t, t + 1) if t > self.task.warm_up else range(0)

    def missed(self, t: int, estimate: np.ndarray) -> np.ndarray:
        """By how much an estimate (n,) misses the readings withheld at t = 1 … T, in standard
        deviations of their noise."""
        return self.off(t, estimate)[self.hidden[self.record.injections[t - 1]]]

    def off(self, t: int, estimate: np.ndarray) -> np.ndarray:
        """(M,) by how much an estimate (n,) misses each reading at t = 1 … T, in standard
        deviations of its noise; NaN where nothing was read."""
        reading = self.record.readings[t - 1]
        k = self.record.injections[t - 1]
        predicted = self._judge.voltages(estimate, self.record.currents[k][None])[0]
        off: np.ndarray = (reading - predicted) / self.task.noise.std(np.nan_to_num(reading))
        return np.where(self.there[k], off, np.nan)

    def _observe(self) -> Observation:
        if self._step > self.episode_steps:
            return {name: np.zeros_like(space.low)  # type: ignore[attr-defined]
                    for name, space in self.observation_space.items()}
        voltages, currents = shown_reading(self.task, self.record, self._step - 1)
        return {"voltages": voltages, "currents": currents.copy()}


def simulated_record(env: EstimationEnv, seed: int) -> Measurements:
    """What an instrument would have written of an episode: currents and readings to the mean of
    all electrodes, in A and V, or in A/m where the pipe is plane. The truth is no part of it."""
    observation, _ = env.reset(seed=seed)
    L = env.task.currents.shape[1]
    V = np.empty((env.episode_steps - env.lag, L))
    I = np.empty_like(V)
    nothing = np.zeros_like(env.action_space.low)  # type: ignore[attr-defined]
    for t in range(len(V)):
        V[t], I[t] = observation["voltages"], observation["currents"]
        observation, *_ = env.step(nothing)
    return Measurements.of_sequence(
        I, np.eye(L), V, env.task.transport.time_step * np.arange(1, len(V) + 1),
        source={"file": f"{env.world.name}, episode {seed}", "assumed": "simulated"})
