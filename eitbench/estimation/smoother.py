"""Bryson–Frazier smoothers without inverses of n×n matrices (1963; docs/methods.md, 6)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from eitbench.estimation.covariance import LowRankCovariance, truncate_columns
from eitbench.estimation.filter import Filter, Step, kalman_filter
from eitbench.estimation.gaussian import LinearMeasurement
from eitbench.estimation.nodal import NodalStates
from eitbench.worlds.task import Estimate


class SmoothedStates:
    """States of the consecutive ``steps`` of a filter, given the measurements of all these steps:
    the fixed-interval smoother, and with the last k + 1 steps the fixed-lag smoother.

    The filter must have a `LowRankCovariance` and a time-invariant motion.
    """

    def __init__(self, filter_: Filter, steps: Sequence[Step]) -> None:
        self._states = list(_adjoints(filter_, steps))

    def estimate(self, lag: int = 0) -> Estimate:
        """Return the mean c + P λ and the variances of P − P N P, ``lag`` steps before the last."""
        step, adjoint = self._states[lag]
        P = step.predicted_covariance
        weighted = P.times(adjoint)
        variance = P.diagonal() - (weighted[:, 1:]**2).sum(axis=1)
        return Estimate(step.predicted_mean + weighted[:, 0], variance)

    def covariance_of(self, functionals: np.ndarray, lag: int = 0) -> np.ndarray:
        """Return the covariance (m, m) of ``functionals`` (m, n) of this state."""
        step, adjoint = self._states[lag]
        weighted = step.predicted_covariance.times(functionals.T)
        gained = weighted.T @ adjoint[:, 1:]
        covariance: np.ndarray = functionals @ weighted - gained @ gained.T
        return 0.5 * (covariance + covariance.T)


def fixed_interval_smoother(start: Filter,
                            observations: Iterable[LinearMeasurement]) -> list[Estimate]:
    """Return c_{t|T} and its variances for t = 1 … T, by a forward and a backward pass."""
    steps = kalman_filter(start, observations)
    smoothed = SmoothedStates(start, steps)
    return [smoothed.estimate(lag) for lag in reversed(range(len(steps)))]


def smooth_means(start: Filter, observations: Iterable[LinearMeasurement]) -> np.ndarray:
    """Return the means c_{t|T} (T, n) of a filter of `NodalStates` with any motion.

    The smoothed state follows forwards from the adjoints λ: c_{0|T} = c_{0|0} + Γ_{0|0} F₁ᵀ λ_1 and
    c_t = F_t c_{t−1} + s_t + Γ_w λ_t (``docs/methods.md``, 6). No variances are computed and no
    covariances stored.
    """
    assert isinstance(start.space, NodalStates)
    space = start.space
    state, initial = space.initial()
    steps = kalman_filter(start, observations)
    adjoints = [adjoint for _, adjoint in _adjoints(start, steps, means_only=True)][::-1]
    state = state + initial.times(space.transition_matrix(steps[0].time).T @ adjoints[0])[:, 0]
    smoothed = np.empty((len(steps), len(state)))
    for k, (step, adjoint) in enumerate(zip(steps, adjoints, strict=True)):
        motion = space.motion(step.time)
        state = smoothed[k] = (motion.apply(state) + motion.forcing
                               + space.noise_times(step.time, adjoint[:, 0]))
    return smoothed


def _adjoints(filter_: Filter, steps: Sequence[Step], *,
              means_only: bool = False) -> Iterator[tuple[Step, np.ndarray]]:
    """Yield (step, [λ, B]) from the last step to the first, from data of this and later steps.

    The adjoint λ and the information N = B Bᵀ satisfy, with S = L Lᵀ,
        λ_t = Hᵀ S⁻¹ ν + (I − K H)ᵀ Fᵀ λ_{t+1},        B_t = [Hᵀ L⁻ᵀ, (I − K H)ᵀ Fᵀ B_{t+1}].
    B is truncated to its numerical rank like the filter's Z; with ``means_only`` it is empty.
    """
    assert isinstance(filter_.space, NodalStates)
    later = np.zeros((len(steps[0].mean), 1))
    for step in reversed(steps):
        factor = cho_factor(step.innovation_covariance, lower=True)
        H = step.matrix
        if step is not steps[-1]:
            later = filter_.space.transition_matrix(step.time + 1).T @ later
            later = later - H.T @ cho_solve(factor, step.cross_covariance.T @ later)
        later[:, 0] += H.T @ cho_solve(factor, step.innovation)
        if not means_only:
            assert isinstance(filter_.covariance, LowRankCovariance)
            information = solve_triangular(factor[0], H, lower=True).T
            information = truncate_columns(np.hstack([later[:, 1:], information]),
                                           filter_.covariance.rank_tolerance)
            later = np.column_stack([later[:, 0], information])
        yield step, later
