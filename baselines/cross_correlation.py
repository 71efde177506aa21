"""Kalman filter with the velocity of cross-correlation (Beck & Plaskowski 1987).

Images of a random walk with the correlation LENGTH and the steps STEP ĉ_bh are averaged over
SECTIONS cross sections of the pipe. The averages of the last WINDOW time steps, without the first
SKIPPED of an episode, are correlated between sections that are GAP apart. The correlation is
largest at the time in which fluid moves from one section to the other. The prior mean of the
velocity is scaled so that its largest value, divided by METER_FACTOR, gives this time. The velocity
is kept where the correlation is below MIN_CORRELATION or has no maximum within FACTORS. An extended
Kalman filter uses it as if it were exact. The constants were chosen on train:0-15 of
Pipe2DUnknownVelocity.
"""

from dataclasses import replace

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import (
    Filter,
    FilterEstimator,
    Step,
    VelocityStates,
    linearise_at_prediction,
    linearise_at_reference,
    nodal_filter,
    task_velocity_prior,
)
from eitbench.estimation.walk import RandomWalk
from eitbench.numerics.fem import mass_matrix

LENGTH = 0.04
"""m"""
STEP, INITIAL_STD = 0.005, 0.25
SECTIONS, GAP, WINDOW = 20, 12, 48
SKIPPED, MIN_PAIRS = 4, 6
METER_FACTOR = 0.9
"""Largest velocity of the profile, relative to the velocity of the correlation, which images that
are blurred along the pipe increase."""
MIN_CORRELATION = 0.7
FACTORS = np.linspace(0.4, 1.7, 66)
"""Velocity relative to the prior mean."""


class CrossCorrelationFilter(Filter):
    """Filter with a velocity from cross-correlation."""

    def __init__(self, task: Task, c_ref: float) -> None:
        flow = task_velocity_prior(task)
        zero = np.zeros_like(flow.initial)
        exact = replace(flow, initial_std=zero, walk_std=zero)
        super().__init__(VelocityStates(task, c_ref, exact), linearise_at_prediction(task))
        self._nominal = self._velocity = flow.initial
        walk = RandomWalk(task.mesh, task.transport.time_step, LENGTH)
        prior = replace(task.prior, nodal_std=STEP, initial_std=INITIAL_STD, initial_length=LENGTH)
        self._images = nodal_filter(walk, prior, c_ref, linearise_at_reference(task, c_ref))
        self._sections, distance = cross_sections(task)
        fastest = (flow.profiles @ flow.initial).max() / METER_FACTOR
        self._lags = distance / (FACTORS * fastest * task.transport.time_step)
        self._averages: list[np.ndarray] = []

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> Step:
        """Use a measurement vector (L,) in V and its injection (L,) in A (A/m in 2D)."""
        self._images.assimilate(voltages, currents)
        self._averages.append(self._sections @ self._images.mean)
        signals = np.array(self._averages[SKIPPED:][-WINDOW:])
        correlations = correlate(signals, GAP, self._lags)
        best = int(np.argmax(correlations))
        if correlations[best] >= MIN_CORRELATION and 0 < best < len(FACTORS) - 1:
            self._velocity = FACTORS[best] * self._nominal
        self.mean[-len(self._velocity):] = self._velocity
        return super().assimilate(voltages, currents)

    def estimate(self, lag: int = 0) -> Estimate:
        """Return the present state."""
        return super().estimate(lag)._replace(velocity_variance=None)


def cross_sections(task: Task) -> tuple[np.ndarray, float]:
    """Return weights (SECTIONS, n) of averages over cross sections, and the distance in m of
    sections that are GAP apart."""
    axial = task.mesh.points[:, np.ptp(task.mesh.points, axis=0).argmax()]
    spacing = np.ptp(axial) / SECTIONS
    centres = axial.min() + spacing * (np.arange(SECTIONS) + 0.5)
    weights = np.maximum(1.0 - np.abs(axial - centres[:, None]) / spacing, 0.0)
    weights *= np.asarray(mass_matrix(task.mesh).sum(axis=0)).ravel()
    return weights / weights.sum(axis=1, keepdims=True), GAP * spacing


def correlate(signals: np.ndarray, gap: int, lags: np.ndarray) -> np.ndarray:
    """Return the correlations of ``signals`` (T, sections) with those ``gap`` sections downstream
    that are later by each of ``lags``, in time steps; linear between the time steps. It is zero
    for fewer than MIN_PAIRS pairs."""
    correlations = []
    for lag in lags:
        whole = int(lag)
        if len(signals) - whole <= MIN_PAIRS:
            correlations.append(0.0)
            continue
        late = signals[whole:-1] + (lag - whole) * np.diff(signals[whole:], axis=0)
        early, late = (each - each.mean(axis=0)
                       for each in (signals[:len(late), :-gap], late[:, gap:]))
        norm = np.sqrt((early**2).sum() * (late**2).sum())
        correlations.append((early * late).sum() / max(norm, 1e-300))
    return np.array(correlations)


class Estimator(FilterEstimator):
    subtracks = ("filter",)
    parameters = {  # noqa: RUF012 (for a record)
        "length": LENGTH, "step": STEP, "initial_std": INITIAL_STD, "sections": SECTIONS,
        "gap": GAP, "window": WINDOW, "skipped": SKIPPED, "meter_factor": METER_FACTOR,
        "min_pairs": MIN_PAIRS, "min_correlation": MIN_CORRELATION,
        "factors": [FACTORS[0], FACTORS[-1], len(FACTORS)]}

    def __init__(self, task: Task) -> None:
        super().__init__(task, lambda c_ref: CrossCorrelationFilter(task, c_ref))

    @staticmethod
    def suits(task: Task) -> bool:
        return task.velocity is not None
