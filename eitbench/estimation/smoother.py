"""Smoothing without inverses of n×n matrices and without stored covariances (Bryson & Frazier 1963; problem.md §7)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from eitbench.estimation.kalman import FilterStep, KalmanFilter, Observation, compressed, kalman_filter


class Smoothed(NamedTuple):
    """c_{t|T} and the diagonal of its covariance."""

    mean: np.ndarray
    """(n,)"""
    variance: np.ndarray
    """(n,)"""


def fixed_interval_smoother(start: KalmanFilter, observations: Iterable[Observation]) -> list[Smoothed]:
    """c_{t|T} for t = 1 … T: filter the record, then come back over it."""
    return smooth(start, kalman_filter(start, observations))


def smooth(filter_: KalmanFilter, steps: Sequence[FilterStep], first: int = 0) -> list[Smoothed]:
    """Smoothed states of ``steps[first:]`` given the measurements of all ``steps``.

    The adjoint λ and the information N = B Bᵀ of later measurements run backwards,
        λ_t = Hᵀ S⁻¹ ν + (I − K H)ᵀ Fᵀ λ_{t+1},        B_t = [Hᵀ L⁻ᵀ, (I − K H)ᵀ Fᵀ B_{t+1}],    S = L Lᵀ,
    and give c_{t|T} = c_{t|t−1} + Γ λ_t and Γ_{t|T} = Γ − Γ N_t Γ with Γ = Γ_{t|t−1} = Π_t − Z Zᵀ. B is compressed to its
    numerical rank like Z.

    Parameters
    ----------
    filter_ : KalmanFilter
        The filter that made the steps.
    steps : sequence of FilterStep
        Consecutive steps up to the last measurement.
    first : int
        Where to stop on the way back; ``len(steps) - 1 - lag`` and then the first result make a fixed-lag smoother.
    """
    n = len(filter_.mean)
    later = np.zeros((n, 1))                                                              # λ, then the columns of B
    results: list[Smoothed] = []
    for index in range(len(steps) - 1, first - 1, -1):
        step = steps[index]
        factor = cho_factor(step.innovation_covariance, lower=True)
        if index < len(steps) - 1:
            later = filter_.transition.T @ later
            later -= step.matrix.T @ cho_solve(factor, step.cross_covariance.T @ later)   # (I − K H)ᵀ
        adjoint = later[:, 0] + step.matrix.T @ cho_solve(factor, step.innovation)
        information = solve_triangular(factor[0], step.matrix, lower=True).T
        information = compressed(np.hstack([later[:, 1:], information]), filter_.rank_tolerance)
        later = np.column_stack([adjoint, information])

        seen = filter_.covariance.apply(step.time, later) - step.known @ (step.known.T @ later)   # Γ [λ, B]
        prior = filter_.covariance.diagonal(step.time) - (step.known**2).sum(axis=1)
        results.append(Smoothed(step.predicted_mean + seen[:, 0], prior - (seen[:, 1:]**2).sum(axis=1)))
    return results[::-1]
