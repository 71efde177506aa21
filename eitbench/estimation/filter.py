"""Kalman filters: one recursion for all state spaces (thesis 5.1, docs/methods.md, 7)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from eitbench.estimation.covariance import Covariance
from eitbench.estimation.gaussian import Forward, LinearMeasurement, condition, innovate
from eitbench.worlds.task import Estimate


class StateSpace:
    """State x of a filter: its evolution, and the concentration as a function of it.

    Subclasses define the state at t = 0 and the propagation of mean and covariance; the other
    methods have defaults for a state that is the concentration itself.
    """

    start: tuple[np.ndarray, Covariance]
    """Mean and covariance at t = 0; not modified"""

    def initial(self) -> tuple[np.ndarray, Covariance]:
        """Return copies of mean and covariance at t = 0."""
        mean, covariance = self.start
        return mean.copy(), covariance.copy()

    def propagate(self, mean: np.ndarray, covariance: Covariance,
                  time: int) -> tuple[np.ndarray, Covariance]:
        """Return mean and covariance at ``time``, one step later."""
        raise NotImplementedError

    def concentration(self, mean: np.ndarray, lag: int = 0) -> np.ndarray:
        """Return the concentration (..., n) in mol/m³ of states (..., k), ``lag`` steps ago."""
        return mean

    def jacobian(self, mean: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        """Return the derivatives (m, k) of ``matrix`` (m, n) c by the first k entries of x."""
        return matrix

    def variance(self, mean: np.ndarray, covariance: Covariance, lag: int = 0) -> np.ndarray:
        """Return the variances (n,) of the concentration in (mol/m³)²."""
        return covariance.diagonal()

    def covariance_of(self, functionals: np.ndarray, mean: np.ndarray, covariance: Covariance,
                      lag: int = 0) -> np.ndarray | None:
        """Return the covariance (m, m) of ``functionals`` (m, n) of the concentration in mol/m³;
        None if it is unknown for this lag."""
        if lag:
            return None
        J = self.jacobian(mean, functionals)
        found: np.ndarray = J @ covariance.times(J.T)[:J.shape[1]]
        return found

    def constrain(self, mean: np.ndarray) -> np.ndarray:
        """Return the nearest admissible mean after a measurement."""
        return mean

    def velocity(self, mean: np.ndarray,
                 covariance: Covariance) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the velocity parameters (k,) in m/s and their variances; None: not estimated."""
        return None


class Step(NamedTuple):
    """Quantities of one filter step, also for the backward pass of a smoother."""

    time: int
    predicted_mean: np.ndarray
    """(n,) x_{t|t−1}"""
    predicted_covariance: Covariance
    """P_{t|t−1}; in the dense form the filter's object, which later steps overwrite"""
    mean: np.ndarray
    """(n,) x_{t|t}"""
    matrix: np.ndarray
    """(m, k) H, derivatives of the measurements by the first k entries of x"""
    innovation: np.ndarray
    """(m,) ν"""
    innovation_covariance: np.ndarray
    """(m, m) S"""
    cross_covariance: np.ndarray
    """(n, m) P_{t|t−1} Hᵀ"""
    accepted: np.ndarray
    """(m,) bool: measurements that passed the gate; the fields above include all measurements"""
    variance: np.ndarray | None = None
    """(n,) diagonal of P_{t|t}; only `kalman_filter` sets it"""


LinearisedMeasurement = tuple[LinearMeasurement, np.ndarray, np.ndarray]
"""Linear measurement, its derivatives (m, k) by the first k entries of x, residual (m,)"""


class Filter:
    """Kalman filter on a state space; extended (EKF) where concentration or voltages are nonlinear.
    ``mean`` and ``covariance`` are of the present state.

    Parameters
    ----------
    space : StateSpace
    forward : callable, optional
        Linearises voltages about a concentration; for `assimilate`.
    gate : float
        Innovation gate: larger deviations, in predicted standard deviations, are rejected.
    iterated : bool
        `assimilate` linearises each measurement vector a second time, about the first estimate.
    """

    def __init__(self, space: StateSpace, forward: Forward | None = None, *,
                 gate: float = math.inf, iterated: bool = False) -> None:
        self.space = space
        self.forward = forward
        self.gate = gate
        self.iterated = iterated
        self.time = 0
        self.mean, self.covariance = space.initial()
        self.step: Step | None = None

    @property
    def concentration(self) -> np.ndarray:
        """(n,) mol/m³: the present mean, about which the next measurement is linearised."""
        return self.space.concentration(self.mean)

    def predict(self) -> None:
        """Advance one time step."""
        self.time += 1
        self.mean, self.covariance = self.space.propagate(self.mean, self.covariance, self.time)

    def update(self, observation: LinearMeasurement) -> Step:
        """Condition on a measurement that is linear in the concentration near the present one."""
        return self._condition(*self._residual(observation, self.concentration))

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> Step:
        """Predict, and condition on voltages (L,) in V for an injection (L,) in A."""
        self.predict()
        before = self.mean, self.covariance.copy() if self.iterated else self.covariance
        step = self._condition(*self._linearise(voltages, currents))
        if not self.iterated:
            return step
        observation, H, residual = self._linearise(voltages, currents)
        residual = residual + H @ (self.mean - before[0])[:H.shape[1]]
        self.mean, self.covariance = before
        again = self._condition(observation, H, residual)
        self.step = again._replace(innovation=step.innovation,
                                   innovation_covariance=step.innovation_covariance)
        return self.step

    def _linearise(self, voltages: np.ndarray, currents: np.ndarray) -> LinearisedMeasurement:
        """Linearise voltages (L,) in V about the present mean, for an injection (L,) in A."""
        assert self.forward is not None, "forward must be given to assimilate voltages"
        concentration = self.concentration
        return self._residual(self.forward(concentration, voltages, currents), concentration)

    def _residual(self, observation: LinearMeasurement,
                  concentration: np.ndarray) -> LinearisedMeasurement:
        H = self.space.jacobian(self.mean, observation.matrix)
        return observation, H, observation.value - observation.matrix @ concentration

    def _condition(self, observation: LinearMeasurement, H: np.ndarray,
                   residual: np.ndarray) -> Step:
        innovation = innovate(self.covariance, H, residual, observation.noise_variance,
                              observation.noise_root)
        predicted = self.mean, self.covariance
        mean, self.covariance, accepted = condition(*predicted, innovation, self.gate)
        self.mean = self.space.constrain(mean)
        self.step = Step(self.time, *predicted, self.mean, H, *innovation, accepted)
        return self.step

    @property
    def variance(self) -> np.ndarray:
        """(n,) (mol/m³)²: present variances of the concentration."""
        return self.space.variance(self.mean, self.covariance)

    def estimate(self, lag: int = 0) -> Estimate:
        """Return the state ``lag`` steps before the present, with the last innovation."""
        space = self.space
        velocity = space.velocity(self.mean, self.covariance) or (None, None)
        innovation = (None, None) if self.step is None else (
            self.step.innovation, self.step.innovation_covariance)
        return Estimate(space.concentration(self.mean, lag),
                        space.variance(self.mean, self.covariance, lag), *innovation, *velocity)

    def covariance_of(self, functionals: np.ndarray, lag: int = 0) -> np.ndarray | None:
        """Return the covariance (m, m) of ``functionals`` (m, n) of the concentration ``lag`` steps
        before the present; None if it is unknown for this lag."""
        return self.space.covariance_of(functionals, self.mean, self.covariance, lag)


def kalman_filter(start: Filter, observations: Iterable[LinearMeasurement]) -> list[Step]:
    """Run ``start`` over a measurement sequence: predict, then update, at each time step."""
    steps = []
    for observation in observations:
        start.predict()
        step = start.update(observation)
        steps.append(step._replace(variance=start.covariance.diagonal()))
    return steps
