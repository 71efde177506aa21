"""Filtering the history of an inflow in which slugs are rare (``docs/methods.md``, 15)."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import solve_triangular

from eitbench import _check
from eitbench.estimation.inflow_history import InflowFilter, State
from eitbench.estimation.kalman import Observation, linearised
from eitbench.estimation.moving_window import Innovation, stationary

if TYPE_CHECKING:
    from eitbench.estimation.inflow_prior import InflowPrior
    from eitbench.worlds.task import Task


class SwitchingInflowFilter:
    """Interacting multiple models (Blom & Bar-Shalom 1988) of what enters: quiet, or a slug.

    Two `InflowFilter` stand side by side. In a slug a new x follows by the prior's regression; in
    quiet it is independent and small. Before each step the two are mixed by the probabilities of
    the regimes that may have come before, by their first two moments; each measurement says how
    well it fits either. What is homogeneous but off from the level, as ĉ_bh is where a slug was in
    the first frame, is a mode of its own, which stays what it is.

    Parameters
    ----------
    task : Task
    prior : InflowPrior
        Of the task's inlet and with `Regimes`; ``ValueError`` if it is not.
    level : float
        ĉ_bh in mol/m³.
    level_std : float
        Of what enters between slugs, in parts of ĉ_bh, > 0.
    """

    def __init__(self, task: Task, prior: InflowPrior, level: float, level_std: float) -> None:
        if prior.regimes is None:
            raise ValueError("prior must have regimes, got one without; make one by "
                             "`eitbench fit prior --quiet`")
        _check.number("level_std", level_std, low=0.0, open_low=True)
        regimes = prior.regimes
        flat = np.full((len(prior.points), 1), level_std)
        modes = np.concatenate([prior.modes / np.sqrt(regimes.variance), flat], axis=1)
        within = replace(prior, modes=modes)
        self.task = task
        self.filters = [InflowFilter(task, within, level) for _ in range(2)]
        """in quiet, in a slug"""
        self.probabilities = np.array([1.0 - regimes.share, regimes.share])
        """(2,) that the present regime is quiet, or a slug"""
        self._transitions = np.array([[1.0 - regimes.begins, regimes.begins],
                                      [regimes.ends, 1.0 - regimes.ends]])
        r = modes.shape[1]
        W = self.filters[0].window
        before, (weights, variance) = stationary(prior.time_covariance(W + 1))
        quiet = np.zeros((W, r))
        quiet[0, -1] = 1.0
        slug = quiet.copy()
        slug[:, :-1] = weights[:, None]
        stays = np.eye(r)[-1]
        self._moves = [(quiet, regimes.quiet * (1.0 - stays)), (slug, variance * (1.0 - stays))]
        covariance = np.kron(regimes.variance * before, np.diag(1.0 - stays))
        covariance += np.kron(np.ones((W, W)), np.diag(stays))
        for each in self.filters:
            each.covariance = covariance

    def predict(self) -> None:
        """Move one time step on: either regime may have come from both."""
        joint = self._transitions * self.probabilities[:, None]
        self.probabilities = joint.sum(axis=0)
        quiet, slug = self.filters
        apart = slug.mean - quiet.mean
        between = np.outer(apart, apart)
        mixed = []
        for a, b in (joint / self.probabilities).T:
            mixed.append((quiet.mean + b * apart,
                          a * quiet.covariance + b * slug.covariance + a * b * between))
        for each, moments, move in zip(self.filters, mixed, self._moves, strict=True):
            each.mean, each.covariance = moments
            each.move(*move)

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Innovation:
        """Take in a measurement (L,) in V of the present state, for the injection (L,) in A.

        It is linearised once, about the mean of both regimes.
        """
        task = self.task
        points = [each.concentration() for each in self.filters]
        observation = linearised(task.observation, task.noise, self.probabilities @ points,
                                 voltages, currents)
        return self.take_in(observation, points)

    def take_in(self, observation: Observation, points: list[np.ndarray]) -> Innovation:
        """Take in a measurement that is linear in the concentration near ``points``, of each
        regime."""
        told = [each.take_in(observation, point)
                for each, point in zip(self.filters, points, strict=True)]
        expected = self.probabilities
        likelihoods = np.array([_log_density(each) for each in told])
        fits = expected * np.exp(likelihoods - likelihoods.max())
        self.probabilities = fits / fits.sum()
        innovation = expected @ [each.value for each in told]
        covariance = sum(p * (each.covariance + np.outer(each.value - innovation,
                                                         each.value - innovation))
                         for p, each in zip(expected, told, strict=True))
        return Innovation(innovation, covariance)

    def state(self) -> State:
        """What is known of the present state: mean and variance of the mixture."""
        means, variances = zip(*(each.state() for each in self.filters), strict=True)
        mean = self.probabilities @ means
        return State(mean, self.probabilities @ (variances + np.square(means - mean)))


def _log_density(innovation: Innovation) -> float:
    """ln N(ν; 0, S), but for a constant."""
    factor = np.linalg.cholesky(innovation.covariance)
    whitened = solve_triangular(factor, innovation.value, lower=True)
    return float(-0.5 * whitened @ whitened - np.log(factor.diagonal()).sum())
