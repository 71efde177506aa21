"""Smoothing that inverts and stores no n×n matrix (Bryson & Frazier 1963; docs/methods.md, 6)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from eitbench.estimation.gate import Filter
from eitbench.estimation.kalman import (
    FilterStep,
    KalmanFilter,
    Observation,
    compressed,
    kalman_filter,
)


class Smoothed(NamedTuple):
    """c_{t|T} and the diagonal of its covariance."""

    mean: np.ndarray
    """(n,)"""
    variance: np.ndarray
    """(n,)"""


def fixed_interval_smoother(start: KalmanFilter,
                            observations: Iterable[Observation]) -> list[Smoothed]:
    """c_{t|T} for t = 1 … T: filter the record, then come back over it."""
    steps = kalman_filter(start, observations)
    return [_smoothed(start, step, later) for step, later in _backwards(start, steps)][::-1]


def smoothed_state(filter_: KalmanFilter, steps: Sequence[FilterStep]) -> Smoothed:
    """The state of the first of consecutive ``steps``, given the measurements of all of them.

    With the last k + 1 steps of ``filter_`` this is the fixed-lag smoother c_{t−k|t}.
    """
    *_, (step, later) = _backwards(filter_, steps)
    return _smoothed(filter_, step, later)


class _Moving(Filter, Protocol):
    """A filter that moves on by itself; after `predict` the others say what it did."""

    mean: np.ndarray

    @property
    def transition(self) -> np.ndarray: ...
    @property
    def forcing(self) -> np.ndarray: ...
    @property
    def apply_noise(self) -> Callable[[np.ndarray], np.ndarray]: ...
    def apply_initial(self, X: np.ndarray) -> np.ndarray: ...
    def predict(self) -> None: ...


def smoothed_means(start: _Moving, observations: Iterable[Observation]) -> np.ndarray:
    """Means c_{t|T} (T, n) of a filter that stands at t = 0 and may move otherwise at each step.

    The adjoint λ_t = Hᵀ S⁻¹ ν + (I − K H)ᵀ Fᵀ_{t+1} λ_{t+1} runs back over the innovations, and the
    smoothed state follows forwards from c_{0|T} = c_{0|0} + Γ_{0|0} F₁ᵀ λ_1 as c_t = F_t c_{t−1} +
    s_t + Γ_w λ_t (``docs/methods.md``, 6): without variances, and without a covariance being kept.
    """
    mean = start.mean
    steps = []
    for observation in observations:
        start.predict()
        expected = start.expect(observation)
        H = observation.matrix
        start.take_in(H, *expected)
        steps.append((H, expected, start.transition, start.forcing, start.apply_noise))
    smoothed = np.empty((len(steps), len(mean)))
    later = np.zeros_like(mean)
    for t in range(len(steps) - 1, -1, -1):
        H, (cross, innovation, S), F, *_ = steps[t]
        smoothed[t] = later + H.T @ np.linalg.solve(S, innovation - cross.T @ later)  # λ_t
        later = F.T @ smoothed[t]
    state = mean + start.apply_initial(later[:, None])[:, 0]
    for t, (*_, F, forcing, apply_noise) in enumerate(steps):
        state = smoothed[t] = F @ state + forcing + apply_noise(smoothed[t])
    return smoothed


def _backwards(filter_: KalmanFilter,
               steps: Sequence[FilterStep]) -> Iterator[tuple[FilterStep, np.ndarray]]:
    """(step, [λ, B]) from the last step to the first: what its own and later measurements say.

    The adjoint λ and the information N = B Bᵀ obey, with S = L Lᵀ,
        λ_t = Hᵀ S⁻¹ ν + (I − K H)ᵀ Fᵀ λ_{t+1},        B_t = [Hᵀ L⁻ᵀ, (I − K H)ᵀ Fᵀ B_{t+1}].
    B is compressed to its numerical rank like the filter's Z.
    """
    later = np.zeros((len(filter_.mean), 1))
    for step in reversed(steps):
        factor = cho_factor(step.innovation_covariance, lower=True)
        if step is not steps[-1]:
            later = filter_.transition.T @ later
            # (I − K H)ᵀ
            later -= step.matrix.T @ cho_solve(factor, step.cross_covariance.T @ later)
        adjoint = later[:, 0] + step.matrix.T @ cho_solve(factor, step.innovation)
        information = solve_triangular(factor[0], step.matrix, lower=True).T
        information = compressed(np.hstack([later[:, 1:], information]), filter_.rank_tolerance)
        later = np.column_stack([adjoint, information])
        yield step, later


def _smoothed(filter_: KalmanFilter, step: FilterStep, later: np.ndarray) -> Smoothed:
    """c_{t|t−1} + Γ λ and the diagonal of Γ − Γ N Γ, with Γ = Γ_{t|t−1} = Π_t − Z Zᵀ."""
    covariance = filter_.covariance
    seen = covariance.apply(step.time, later) - step.known @ (step.known.T @ later)
    prior = covariance.diagonal(step.time) - (step.known**2).sum(axis=1)
    return Smoothed(step.predicted_mean + seen[:, 0], prior - (seen[:, 1:]**2).sum(axis=1))
