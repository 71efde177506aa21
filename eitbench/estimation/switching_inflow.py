"""Filters for inflows with rare slugs: two regimes of the inflow (``docs/methods.md``, 15)."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from itertools import cycle

import numpy as np
from scipy.linalg import solve_triangular

from eitbench import _check
from eitbench.estimation.covariance import DenseCovariance
from eitbench.estimation.filter import Filter, Step
from eitbench.estimation.gaussian import Forward, LinearMeasurement
from eitbench.estimation.inflow_prior import InflowPrior
from eitbench.estimation.inflow_window import InflowWindow, window_model
from eitbench.worlds.task import Estimate, Task

NEGLIGIBLE = 1e-3
"""Particles with less than this fraction of the largest probability do not enter estimates."""


class SwitchingInflowFilter:
    """Interacting multiple models (Blom & Bar-Shalom 1988) of the inflow: quiet, or a slug.

    Two filters of an `InflowWindow` run in parallel. In a slug a new x follows the prior's
    regression; in the quiet regime it is independent and small. Before each step the means and
    covariances are mixed with the probabilities of the preceding regimes, which each measurement
    vector updates by its likelihood. A homogeneous deviation from c_ref, which occurs if a slug was
    in the first frame, is a separate constant mode.

    Parameters
    ----------
    task, prior, c_ref
        As in `InflowWindow`; ``ValueError`` if the prior has no `Regimes`.
    level_std : float
        Standard deviation of the background between slugs, relative to ĉ_bh, > 0.
    forward : callable
        Linearises voltages about a concentration; for `assimilate`.
    """

    def __init__(self, task: Task, prior: InflowPrior, c_ref: float, level_std: float,
                 forward: Forward) -> None:
        if prior.regimes is None:
            raise ValueError("prior must have regimes, got one without; fit one with "
                             "`eitbench fit prior --quiet`")
        _check.number("level_std", level_std, low=0.0, open_low=True)
        regimes = prior.regimes
        flat = np.full((len(prior.points), 1), level_std)
        modes = np.concatenate([prior.modes / np.sqrt(regimes.variance), flat], axis=1)
        within = replace(prior, modes=modes)
        spaces = [InflowWindow(task, within, c_ref) for _ in range(2)]
        self.probabilities = np.array([1.0 - regimes.share, regimes.share])
        """(2,) probabilities of the present regime: quiet, slug"""
        self._transitions = np.array([[1.0 - regimes.p_onset, regimes.p_onset],
                                      [regimes.p_end, 1.0 - regimes.p_end]])
        W = spaces[0].window_steps
        slug, variance, covariance = window_model(prior, W, 1)
        is_inflow = np.repeat([True, False], [prior.modes.shape[1], 1])
        quiet = np.where(is_inflow, 0.0, slug)
        spaces[0].ar_model = quiet, regimes.quiet_variance_ratio * is_inflow
        spaces[1].ar_model = slug, variance
        std = np.tile(np.where(is_inflow, np.sqrt(regimes.variance), 1.0), W)
        covariance = std[:, None] * covariance * std
        self.filters = [Filter(space) for space in spaces]
        """filters of the regimes: quiet, slug"""
        for each in self.filters:
            each.covariance = DenseCovariance(covariance)
        self._forward = forward
        self._innovation: tuple[np.ndarray, np.ndarray] | tuple[None, None] = (None, None)

    def predict(self) -> None:
        """Mix the regimes, and advance one time step."""
        joint = self._transitions * self.probabilities[:, None]
        self.probabilities = joint.sum(axis=0)
        quiet, slug = self.filters
        apart = slug.mean - quiet.mean
        between = np.outer(apart, apart)
        P, Q = (each.covariance.array for each in self.filters)
        mixed = [(quiet.mean + b * apart, DenseCovariance(a * P + b * Q + a * b * between))
                 for a, b in (joint / self.probabilities).T]
        for each, (mean, covariance) in zip(self.filters, mixed, strict=True):
            each.mean, each.covariance = mean, covariance
            each.predict()

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> None:
        """Predict, and condition on voltages (L,) in V for an injection (L,) in A.

        The voltages are linearised once, about the mean of both regimes.
        """
        self.predict()
        mean = self.probabilities @ [each.concentration for each in self.filters]
        self.update(self._forward(mean, voltages, currents))

    def update(self, observation: LinearMeasurement) -> None:
        """Condition on a measurement that is linear in the concentration near all means."""
        self._weigh([each.update(observation) for each in self.filters])

    def _weigh(self, steps: list[Step]) -> None:
        """Update the probabilities by the likelihoods of a measurement."""
        expected = self.probabilities
        likelihoods = np.array([_log_density(step) for step in steps])
        fits = expected * np.exp(likelihoods - likelihoods.max())
        self.probabilities = fits / fits.sum()
        values = np.array([step.innovation for step in steps])
        innovation = expected @ values
        apart = values - innovation
        within = np.tensordot(expected, [step.innovation_covariance for step in steps], 1)
        self._innovation = innovation, within + (expected * apart.T) @ apart

    def estimate(self, lag: int = 0) -> Estimate:
        """Return mean and variance of the mixture, with the last innovation."""
        means = np.array([each.concentration for each in self.filters])
        mean = self.probabilities @ means
        variances = np.array([each.variance for each in self.filters])
        return Estimate(mean, self.probabilities @ (variances + (means - mean)**2),
                        *self._innovation)

    def covariance_of(self, functionals: np.ndarray, lag: int = 0) -> np.ndarray:
        """Return the covariance (m, m) of ``functionals`` (m, n) of the present concentration."""
        values = np.array([each.concentration for each in self.filters]) @ functionals.T
        apart = values - self.probabilities @ values
        within = np.array([each.covariance_of(functionals) for each in self.filters])
        return np.tensordot(self.probabilities, within, 1) + (self.probabilities * apart.T) @ apart


class ParticleInflowFilter(SwitchingInflowFilter):
    """Rao–Blackwellised particle filter of the two regimes; a particle is a regime sequence.

    Each particle has a Kalman filter, linearised about its own prediction. At each step the
    particles are resampled, and N ≥ 1 ``particles`` branch into both regimes, so that 2 N filters
    run. With at most N sequences the result is exact except for the linearisation.
    """

    def __init__(self, task: Task, prior: InflowPrior, c_ref: float, level_std: float,
                 forward: Forward, particles: int, random: np.random.Generator) -> None:
        super().__init__(task, prior, c_ref, level_std, forward)
        self.particles = _check.integer("particles", particles, low=1)
        self._spaces = [each.space for each in self.filters]
        self._random = random

    def predict(self) -> None:
        """Advance one time step: each particle branches into both regimes."""
        kept, weights = resample(self.probabilities, self.particles, self._random)
        self.probabilities = (weights[:, None] * self._transitions[kept % 2]).ravel()
        self.filters = [copy(self.filters[k]) for k in kept for _ in range(2)]
        for each, space in zip(self.filters, cycle(self._spaces)):  # quiet and slug, alternating
            each.space = space
            each.covariance = copy(each.covariance)  # shallow: `shift` allocates a new array
            each.predict()

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> None:
        """Predict, and condition each particle on voltages (L,) in V for an injection (L,) in A."""
        self.predict()
        self._weigh([each.update(self._forward(each.concentration, voltages, currents))
                     for each in self.filters])

    def estimate(self, lag: int = 0) -> Estimate:
        """Return mean and variance of the particles with more than `NEGLIGIBLE` of the largest
        probability, with the last innovation."""
        p, likely = self.probabilities, copy(self)
        kept = np.flatnonzero(p > NEGLIGIBLE * p.max())
        likely.filters = [self.filters[k] for k in kept]
        likely.probabilities = p[kept] / p[kept].sum()
        return super(ParticleInflowFilter, likely).estimate(lag)


def resample(probabilities: np.ndarray, count: int,
             random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return indices and new probabilities of at most ``count`` particles, without bias.

    Particles above a threshold are kept; some of the others are drawn systematically and get the
    threshold as probability (Fearnhead & Clifford, J. R. Stat. Soc. B 65, 2003).
    """
    if len(probabilities) <= count:
        return np.arange(len(probabilities)), probabilities
    order = np.argsort(-probabilities)
    w = probabilities[order]
    draws = count - np.arange(count)
    threshold = w[::-1].cumsum()[::-1][:count] / draws
    first = int(np.argmax(w[:count] <= threshold))
    places = threshold[first] * (random.uniform() + np.arange(draws[first]))
    drawn = np.minimum(np.searchsorted(w[first:].cumsum(), places), len(w) - first - 1)
    weights = np.where(np.arange(count) < first, w[:count], threshold[first])
    return order[np.concatenate([np.arange(first), first + drawn])], weights


def _log_density(step: Step) -> float:
    """Return ln N(ν; 0, S) up to a constant."""
    read = step.accepted
    root = np.linalg.cholesky(step.innovation_covariance[np.ix_(read, read)])
    whitened = solve_triangular(root, step.innovation[read], lower=True)
    return float(-0.5 * whitened @ whitened - np.log(root.diagonal()).sum())
