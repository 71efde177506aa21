"""`Task` of a measurement file: motion, noise and prior, fitted by maximum evidence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from eitbench import _check
from eitbench.estimation.gaussian import LinearisedForwardModel, condition, innovate
from eitbench.estimation.nodal import modal_states
from eitbench.estimation.walk import RandomWalk, matern32_transition, matern_modes
from eitbench.measured.calibration import Calibration
from eitbench.measured.measurements import Measurements
from eitbench.measured.model import MeasurementModel, available_channels, visible_measurement
from eitbench.measured.vessel import VesselConfig
from eitbench.physics.observation import LinearConductivity, ObservationModel
from eitbench.physics.profiles import parabolic_model
from eitbench.physics.stationary import StationaryTransport
from eitbench.physics.transport import ConvectionDiffusion
from eitbench.worlds.task import Task
from eitbench.worlds.vessels import PlanePipe, RoundPipe
from eitbench.worlds.world import Prior

SMOOTHNESS_FRACTION = 1 / 8
"""Correlation length of a target relative to the vessel's size."""
MODEL_ERROR = 0.01
"""Relative model error from electrodes displaced by a millimetre and a plane model of a tank."""
N_SPANS, SPAN_FRAMES = 3, 2
"""Number of evenly distributed spans for which evidence is computed, and their frames."""
INITIAL_GUESS = {"noise": 3.0, "initial": 0.3, "walk": 0.03}
STD_LIMITS = {"initial": (1e-2, 1.0), "walk": (1e-4, 1.0)}
"""Standard deviations relative to the background."""
NOISE_LIMITS = {True: (1.0, 1e3), False: (0.1, 10.0)}
"""Factor of the noise: fitted to repeats, without model error (True), or to the misfit (False)."""
RATE_LIMITS = (1e-2, 3.0)
"""1/λ relative to the duration of a frame."""


def task_from_measurements(vessel: VesselConfig, calibration: Calibration,
                           measurements: Measurements, *, mask: np.ndarray | None = None,
                           moves: bool = True, molar_conductivity: float = 0.01,
                           model_error: float = MODEL_ERROR, length: float | None = None,
                           initial_std: float | None = None,
                           walk_std: float | None = None) -> Task:
    """Build the task of a target that moves at random, is stationary, or is advected by the flow of
    the vessel.

    Estimates are concentrations c with conductivity σ = Λ c. Without a flow, maximum evidence
    determines the factor of the noise, and ``initial_std`` and ``walk_std`` unless specified; with
    a flow, the default `Prior` holds. ``ValueError`` names an argument out of range.

    Parameters
    ----------
    mask : (K, M) bool, optional
        Measurements that are visible to the estimator. Default: all complete channels.
    moves : bool
        True if the target moves.
    molar_conductivity : float
        Λ in S·m²/mol.
    model_error : float
        Relative model error of inhomogeneous fluid. If the target moves, it is added to a noise
        fitted to repeats, since a random walk would explain the error by motion.
    length : float, optional
        Correlation length of the target in m. Default: an eighth of the vessel.
    initial_std, walk_std : float, optional
        Standard deviation of the initial state, and of a step of the random walk between two
        injections, relative to the background.
    """
    _check.number("molar_conductivity", molar_conductivity, low=0.0, open_low=True,
                  units="S·m²/mol")
    _check.number("model_error", model_error, low=0.0, high=1.0)
    mesh = vessel.transport_mesh()
    cem = vessel.electrode_model(calibration.contact_impedance)
    background = calibration.conductivity / molar_conductivity
    mean, model = calibration.mean_voltages, calibration.model_voltages
    corrects_offset, corrects_gain = (calibration.correction == each for each in ("offset", "gain"))
    observation: Any = MeasurementModel(                # estimators require a `VoltageModel` only
        ObservationModel(cem, mesh.interpolation_to(cem.mesh.points[:, :mesh.dim]),
                         LinearConductivity(molar_conductivity), 1e-3 * background),
        measurements.currents, calibration.gain * measurements.matrix, vessel.depth,
        offset=np.nan_to_num(mean - model) if corrects_offset else 0.0,
        gain=np.nan_to_num(mean / model, nan=1.0) if corrects_gain else 1.0,
        mask=available_channels(measurements) if mask is None else mask)
    T, frame = len(measurements.injection_index), measurements.frame_length
    step = float(np.median(np.diff(measurements.times))) if T > 1 else 1.0
    noise = calibration.noise
    if calibration.noise_from_repeats and moves:
        noise = replace(noise, relative=float(np.hypot(noise.relative, model_error)))
    task = Task(StationaryTransport(mesh, step), observation, noise, measurements.currents, T,
                min(frame, T - 1), 0, background, min(frame, T), Prior(background))
    if moves and vessel.flow is not None:
        return _with_flow(task, vessel)
    if length is None:
        length = SMOOTHNESS_FRACTION * float(np.ptp(mesh.points, axis=0).max())
    prior = Prior(background, nodal_std=walk_std or 0.0, initial_std=initial_std or 0.0,
                  initial_length=length)
    task = replace(task, prior=prior)
    if moves:
        task = replace(task, transport=RandomWalk(mesh, step, length))
    free = ["noise", *["initial"] * (initial_std is None), *["walk"] * (moves and walk_std is None)]
    task = maximise_evidence(task, measurements, free, NOISE_LIMITS[calibration.noise_from_repeats])
    if not moves:
        return task
    phi = _ar_coefficient(task.prior.initial_std, task.prior.nodal_std)
    rate = maximise_rate_evidence(task, measurements)
    return replace(task, transport=RandomWalk(mesh, step, length, phi, rate))


def _with_flow(task: Task, vessel: VesselConfig) -> Task:
    """Replace the transport by convection–diffusion, and add the velocity if it is estimated."""
    shape, flow = vessel.shape, vessel.flow
    assert isinstance(shape, PlanePipe | RoundPipe) and flow is not None
    transport = ConvectionDiffusion(
        task.mesh, shape.laminar_velocity(flow.mean_velocity), flow.diffusivity,
        task.transport.time_step, substeps=shape.substeps(fine=False),
        inlet=shape.transport_mesh(fine=False)[1])
    velocity = None
    if flow.velocity_std:
        assert isinstance(shape, PlanePipe)
        velocity = parabolic_model(shape.half_width, flow.mean_velocity, flow.velocity_std,
                                   flow.velocity_walk)
    return replace(task, transport=transport, velocity=velocity)


def maximise_evidence(task: Task, measurements: Measurements, free: list[str],
                      noise_limits: tuple[float, float]) -> Task:
    """Maximise the evidence by the ``free`` parameters: factor of the ``noise``, ``initial`` and
    ``walk`` standard deviation.

    The evidence is the marginal likelihood of some frames under a linearised Kalman filter on the
    modes of the smoothness prior.
    """
    limits = STD_LIMITS | {"noise": noise_limits}
    evidence = _NegTwoLogEvidence(task, measurements)
    fixed = {"noise": 1.0, "initial": task.prior.initial_std, "walk": task.prior.nodal_std}

    def parameters(x: np.ndarray) -> dict[str, float]:
        return fixed | {name: float(np.exp(value)) for name, value in zip(free, x, strict=True)}

    def objective(x: np.ndarray) -> float:
        values = parameters(x)
        phi = _ar_coefficient(values["initial"], values["walk"])
        return evidence(values["noise"], values["initial"], partial(_ar1_transition, phi))

    from scipy.optimize import minimize  # lazy import: takes half a second
    optimum = minimize(objective, np.log([INITIAL_GUESS[name] for name in free]),
                       method="Nelder-Mead", bounds=np.log([limits[name] for name in free]),
                       options={"xatol": 0.03, "fatol": 0.1, "maxfev": 60 * len(free)})
    best = parameters(optimum.x)
    factor, noise = best["noise"], task.noise
    return replace(
        task, noise=replace(noise, relative=factor * noise.relative,
                            relative_to_max=factor * noise.relative_to_max,
                            floor=factor * noise.floor),
        prior=replace(task.prior, initial_std=best["initial"],
                      nodal_std=min(best["walk"], best["initial"])))


def maximise_rate_evidence(task: Task, measurements: Measurements) -> float:
    """Return the rate λ in 1/s of a Matérn-3/2 motion that maximises the evidence, with the task's
    noise and initial standard deviation."""
    evidence = _NegTwoLogEvidence(task, measurements)
    frame = max(task.warm_up, 1)
    from scipy.optimize import minimize_scalar  # lazy import: takes half a second
    optimum = minimize_scalar(
        lambda x: evidence(1.0, task.prior.initial_std,
                           lambda steps: matern32_transition(np.exp(x) * steps)),
        bounds=np.log([each / frame for each in RATE_LIMITS]), method="bounded",
        options={"xatol": 0.05})
    return float(np.exp(optimum.x)) / task.transport.time_step


def _ar1_transition(phi: float, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return A and Q (1, 1) of an AR(1) process with unit variance over a number of steps."""
    a = phi**steps
    return np.array([[a]]), np.array([[1.0 - a**2]])


def _ar_coefficient(initial: float, walk: float) -> float:
    """Return φ, for which a walk of this standard deviation conserves the initial variance."""
    return float(np.sqrt(max(1.0 - (walk / initial)**2, 0.0)))


class _NegTwoLogEvidence:
    """Function −2 ln p(some frames) + constant of noise, initial std and motion."""

    def __init__(self, task: Task, measurements: Measurements) -> None:
        model: Any = task.observation
        frames = SPAN_FRAMES * task.calibration
        starts = np.linspace(0, max(task.n_steps - frames, 0), N_SPANS).round().astype(int)
        used = np.unique(np.minimum(starts[:, None] + np.arange(frames), task.n_steps - 1))
        self._steps = np.diff(used, prepend=-1)
        modes = task.expected_concentration * matern_modes(task.mesh, task.prior.initial_length)
        point = np.full(task.mesh.n_nodes, task.expected_concentration)
        linear = LinearisedForwardModel(task.observation, task.noise, point)
        self._data = []
        for voltages, currents in (visible_measurement(model, measurements, t) for t in used):
            H, value, variance, _ = linear(voltages, currents)
            visible = H.any(axis=1) & np.isfinite(value)
            self._data.append((H[visible] @ modes, (value - H @ point)[visible], variance[visible]))

    def __call__(self, noise: float, initial: float,
                 motion: Callable[[int], tuple[np.ndarray, np.ndarray]]) -> float:
        states = modal_states(self._data[0][0].shape[1], initial, motion)
        mean, covariance = states.initial()
        total = 0.0
        for steps, (H, value, variance) in zip(self._steps, self._data, strict=True):
            mean, covariance = states.propagate(mean, covariance, int(steps))
            innovation = innovate(covariance, H, value - H @ mean[:H.shape[1]], noise**2 * variance)
            mean, covariance, _ = condition(mean, covariance, innovation)
            S = innovation.covariance
            total += float(innovation.value @ np.linalg.solve(S, innovation.value))
            total += float(np.linalg.slogdet(S)[1])
        return total
