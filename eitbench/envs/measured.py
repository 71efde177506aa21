"""Environments of measurements: ``eitbench/Measured-v0`` for a user's file, and one id per case."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from eitbench import _check
from eitbench._extras import require_extra
from eitbench.envs.episodes import (
    RENDER_MODES,
    RESET_NEEDED,
    FixedLengthEnv,
    Observation,
    can_render,
    check_render_mode,
)
from eitbench.envs.estimation import check_actions
from eitbench.measured import Measurements, quality, read
from eitbench.measured.calibration import calibrate, noise_from_frames
from eitbench.measured.cases import MeasuredCase, read_case
from eitbench.measured.model import (
    MeasurementModel,
    available_channels,
    sample_withheld,
    visible_measurement,
)
from eitbench.measured.task import task_from_measurements
from eitbench.measured.vessel import INITIAL_CONTACT_IMPEDANCE, VesselConfig, read_vessel
from eitbench.worlds.task import Task

NOISE_FRAMES = 1000
"""Largest number of first frames from which the noise is estimated."""
NO_REFERENCE = ("A homogeneous frame is missing: the only frame is used as its own reference, so "
                "images show no target, and nothing is scored. The correction 'none' gives an "
                "absolute image.")
WITHHOLDING_SEEDS = 100_000
"""Size of a split of seeds: ``test:3``, ``dev:3`` and ``train:3`` share their withheld mask."""


class MeasuredEnv(FixedLengthEnv):
    """Estimate the concentration in a real vessel from measurements, without ground truth.

    ## Action Space

    At step t = 1 … T the action is the estimate of the state at the t-th injection: the
    concentration at the nodes of `task.mesh` in mol/m³. Where the velocity is estimated too
    (`task.velocity`), its parameters in m/s follow.

    ## Observation Space

    A `Dict` with the voltages, (M,) V, and currents, (L,) A, of the active injection. Channels that
    are withheld or never measured are 0; the mask of the task's `MeasurementModel` excludes them.
    A single measurement that was lost, or is a spike, is NaN.

    ## Rewards

    −mean ((measured − predicted)/std)² over the withheld measurements of the active injection, 0 in
    the first frame. For a stationary target, all withheld measurements score the last estimate.

    ## Starting State

    `reset(seed=s)` draws the withheld channels of each injection, the same at each of its uses;
    without a seed, the random generator of the environment draws s.

    ## Episode End

    Terminated after T steps. Never truncated.

    ## Arguments

    | name | default | meaning |
    |---|---|---|
    | `file` | | a file for `eitbench.measured.read`, or `Measurements` |
    | `vessel` | | a file or mapping for `read_vessel`, or a `VesselConfig` |
    | `withheld` | 0.1 | withheld fraction of the measurements, from 0 to 0.5 |
    | `moves` | None | whether the target moves; None: with two complete frames or more, or a flow |
    | `correction` | "offset" | of the misfit on homogeneous fluid; see `calibrate` |
    | `homogeneous_frames` | 1 | number of first frames that replace a missing reference |
    | `render_mode` | None | "rgb_array": last estimate, active electrodes |

    and the arguments of `task_from_measurements`. A case, such as `eitbench/Measured-iirc-v0`,
    fixes all but `file` and `render_mode`.
    """

    metadata = {"render_modes": RENDER_MODES, "render_fps": 8}  # noqa: RUF012 (gymnasium's form)
    lag = 0

    def __init__(self, file: Path | str | Measurements,
                 vessel: Path | str | Mapping[str, Any] | VesselConfig, *, withheld: float = 0.1,
                 moves: bool | None = None, correction: str = "offset",
                 homogeneous_frames: int = 1, render_mode: str | None = None,
                 **options: Any) -> None:
        self.render_mode = check_render_mode(render_mode)
        measurements = file if isinstance(file, Measurements) else read(file)
        self.vessel = vessel if isinstance(vessel, VesselConfig) else read_vessel(vessel)
        self.case: MeasuredCase | None = None
        spikes = quality.find_spikes(measurements.voltages, measurements.injection_index)
        self._warnings = quality.spike_warnings(measurements, spikes)
        if spikes.any():
            measurements = replace(measurements,
                                   voltages=np.where(spikes, np.nan, measurements.voltages))
        self.measurements = measurements
        T, (M, L) = len(measurements.injection_index), measurements.matrix.shape
        if (count := self.vessel.shape.n_electrodes) != L:
            raise ValueError(f"vessel must have the {L} electrodes of the measurements, got "
                             f"{count}")
        self.withheld = _check.number("withheld", withheld, low=0.0, high=0.5)
        reference = measurements.reference_frames(homogeneous_frames)
        self._electrodes = self.vessel.electrode_model(INITIAL_CONTACT_IMPEDANCE)
        self.calibration = calibrate(
            self._electrodes, measurements.currents, measurements.matrix, reference,
            depth=self.vessel.depth, conductivity=self.vessel.conductivity, correction=correction,
            noise=(None if len(reference) > 1
                   else noise_from_frames(measurements.frames(NOISE_FRAMES))))
        if moves is None:
            moves = self.vessel.flow is not None or 2 * measurements.frame_length <= T
        self._options = {"moves": moves, **options}
        is_own_reference = (measurements.reference is None and correction != "none"
                            and homogeneous_frames * measurements.frame_length >= T)
        if is_own_reference:
            self._warnings.append(NO_REFERENCE)
            self.withheld = 0.0
        self.available = available_channels(measurements)
        """(K, M) bool: channels that are measured, see `available_channels`"""
        if correction != "none":
            self.available &= np.isfinite(self.calibration.mean_voltages)
        self.episode_steps = T
        self._last: np.ndarray | None = None
        self._seed = -1
        self._step = 0
        self._withhold(0)
        voltage = 100.0 * measurements.max_abs_voltage
        current = float(np.abs(measurements.currents).max())
        self.observation_space: spaces.Dict = spaces.Dict({  # type: ignore[assignment]
            "voltages": spaces.Box(-voltage, voltage, (M,), np.float64),
            "currents": spaces.Box(-current, current, (L,), np.float64)})
        limit = np.full(self.task.mesh.n_nodes, 1e4 * self.task.expected_concentration)
        if self.task.velocity is not None:
            limit = np.append(limit, 1e2 * np.abs(self.task.velocity.nominal))
        self.action_space: spaces.Box = spaces.Box(-limit, limit, dtype=np.float64)

    def _withhold(self, seed: int) -> None:
        """Draw the withheld measurements, and build the task without them."""
        if seed == self._seed:
            return
        self.withheld_mask = sample_withheld(self.available, self.withheld, seed)
        """(K, M) bool: measurements that the observations omit"""
        self.task: Task = task_from_measurements(
            self.vessel, self.calibration, self.measurements,
            mask=self.available & ~self.withheld_mask,
            **self._options)
        """information for the agent"""
        self._full_model = replace(self.model, mask=self.available)
        self._seed = seed

    @property
    def model(self) -> MeasurementModel:
        """The observation model of the task."""
        model = self.task.observation
        assert isinstance(model, MeasurementModel)
        return model

    def reset(self, *, seed: int | None = None,
              options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Begin the measurements; the seed, or without one a random number, determines the
        withheld channels."""
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(WITHHOLDING_SEEDS))
        self._withhold(seed % WITHHOLDING_SEEDS)
        self._step = 1
        self._last = None
        return self._observe(), {"step": 1}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Take the estimate (n,) in mol/m³ of the state at the last measurement, followed by the
        parameters of the flow in m/s if the velocity is estimated."""
        if not 1 <= self._step <= self.episode_steps:
            raise gym.error.ResetNeeded(RESET_NEEDED)
        n = self.task.mesh.n_nodes
        self._last = estimate = check_actions(action, self.action_space, n)[:n].copy()
        reward = 0.0
        if steps := self.scoring_steps(self._step):
            residuals = np.concatenate([self.withheld_residuals(t, estimate)[0] for t in steps])
            reward = -float(np.mean(residuals**2)) if len(residuals) else 0.0
        self._step += 1
        return (self._observe(), reward, self._step > self.episode_steps, False,
                {"step": self._step})

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """(height, width, 3) uint8: last estimate, electrodes; None without a mode."""
        if not can_render(self):
            return None
        with require_extra("render()"):
            from eitbench.envs.rendering import draw_frame
        t = max(self._step - 2, 0)
        estimate = self._last
        if estimate is None:
            estimate = np.full(self.task.mesh.n_nodes, self.task.expected_concentration)
        currents = self.measurements.currents[self.measurements.injection_index[t]]
        return draw_frame(self.task, [("estimate", self.task.mesh, estimate)], currents,
                          float(self.measurements.times[t]))

    def quality_warnings(self) -> list[str]:
        """Return data-quality warnings; see `eitbench.measured.quality`."""
        return [*self._warnings, *quality.quality_warnings(self.measurements, self.calibration,
                                                           self._electrodes)]

    def scoring_steps(self, t: int) -> range:
        """Return the injections, 1 … T, whose withheld measurements score an estimate at t."""
        if self.task.is_stationary:
            return range(1, self.episode_steps + 1) if t == self.episode_steps else range(0)
        return range(t, t + 1) if t > self.task.warm_up else range(0)

    def withheld_residuals(self, t: int, estimate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals of an estimate (n,) in the measurements withheld at t = 1 … T: relative to the
        standard deviation of their noise, and in V."""
        residuals = self.residuals(t, estimate)
        is_scored = (self.withheld_mask[self.measurements.injection_index[t - 1]]
                     & np.isfinite(residuals))
        std = self.task.noise.std(np.nan_to_num(self.measurements.voltages[t - 1]))
        return residuals[is_scored], (residuals * std)[is_scored]

    def residuals(self, t: int, estimate: np.ndarray) -> np.ndarray:
        """(M,) residuals of an estimate (n,) in all measurements of t = 1 … T, relative to the
        standard deviation of their noise; NaN where nothing was measured."""
        measured = self.measurements.voltages[t - 1]
        k = self.measurements.injection_index[t - 1]
        predicted = self._full_model.voltages(estimate, self.measurements.currents[k][None])[0]
        residuals = (measured - predicted) / self.task.noise.std(np.nan_to_num(measured))
        found: np.ndarray = np.where(self.available[k], residuals, np.nan)
        return found

    def _observe(self) -> Observation:
        if self._step > self.episode_steps:
            return {name: np.zeros_like(space.low)  # type: ignore[attr-defined]
                    for name, space in self.observation_space.items()}
        voltages, currents = visible_measurement(self.model, self.measurements, self._step - 1)
        return {"voltages": voltages, "currents": currents.copy()}


def case_env(case: Path | str, file: Path | str | None = None,
             render_mode: str | None = None) -> MeasuredEnv:
    """Build the environment of a case; ``ValueError`` names a ``file`` that is missing."""
    found = read_case(case)
    env = MeasuredEnv(found.measurements(file), dict(found.vessel), render_mode=render_mode,
                      **found.options)
    env.case = found
    return env
