"""Priors of the inflow: a Gaussian process in time and across the inlet, or its exponential
(``docs/methods.md``, 10)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from eitbench import _check
from eitbench._files import write_atomically
from eitbench._notice import notify
from eitbench.data.seeds import SPLITS, format_seed
from eitbench.worlds.registry import entries
from eitbench.worlds.task import Task
from eitbench.worlds.world import World

REGIME_KEYS = {"p_onset": "begins", "p_end": "ends", "quiet_variance_ratio": "quiet"}
"""Field of `Regimes` -> its key in files of priors."""
LINK_NAMES = ("linear", "logarithm")
"""Gaussian quantity: c_in/ĉ_bh − 1, or ln(c_in/ĉ_bh)."""
NODE_ATOL_M = 1e-6
"""Tolerance in m for equal nodes: an obstacle downstream moves the inlet's nodes slightly."""
MIN_STEPS = 16
"""Minimum number of steps of an inflow for estimating its correlation."""


@dataclass(frozen=True)
class Regimes:
    """Markov chain of two regimes, quiet and slug, for rare slugs. ``ValueError`` naming the
    argument that is out of range."""

    p_onset: float
    """probability that a slug begins after a quiet step"""
    p_end: float
    """probability that a slug ends after a step"""
    quiet_variance_ratio: float
    """variance of the inflow in the quiet regime, relative to that in slugs"""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            _check.number(name, value, low=0.0, high=1.0, open_low=True)

    @property
    def share(self) -> float:
        """Fraction of the steps in which a slug enters."""
        return self.p_onset / (self.p_onset + self.p_end)

    @property
    def variance(self) -> float:
        """Variance of all inflows, relative to that in slugs."""
        return self.share + (1.0 - self.share) * self.quiet_variance_ratio


@dataclass(frozen=True, eq=False)
class InflowPrior:
    """Prior u ~ N(0, Γ_time ⊗ Γ_across), u = c_in/ĉ_bh − 1 or ln(c_in/ĉ_bh) at the inlet's nodes.

    Γ_across = E Eᵀ with E the `modes`, and Γ_time is stationary: u = E x with independent rows of
    x, each of unit variance and of this `correlation` in time. ``ValueError`` naming the argument.
    """

    link: str
    """one of `LINK_NAMES`"""
    points: np.ndarray
    """(n_inlet, d) m; the nodes of the model's inlet"""
    modes: np.ndarray
    """(n_inlet, r) E, relative to ĉ_bh"""
    correlation: np.ndarray
    """(K,) correlation at lags of 0 … K − 1 time steps, first entry 1; zero beyond"""
    time_step: float
    """s"""
    source: Mapping[str, Any] = field(default_factory=dict)
    """provenance, serialisable as JSON"""
    regimes: Regimes | None = None
    """for filters that switch between slug and quiet; None: not estimated"""

    def __post_init__(self) -> None:
        _check.choice("link", self.link, LINK_NAMES)
        _check.number("time_step", self.time_step, low=0.0, open_low=True, units="s")
        points = _check.array("points", self.points, (None, None), units="m")
        modes = _check.array("modes", self.modes, (len(points), None))
        correlation = _check.array("correlation", self.correlation, (None,))
        if not len(correlation) or correlation[0] != 1.0 or np.abs(correlation).max() > 1.0:
            raise ValueError("correlation must begin with 1 and have no larger entry, got "
                             f"{correlation[:3]} …")
        for name, array in (("points", points), ("modes", modes), ("correlation", correlation)):
            object.__setattr__(self, name, array)

    @property
    def correlation_steps(self) -> int:
        """Lag in time steps from which on the correlation is below 0.1."""
        return int(np.flatnonzero(np.abs(self.correlation) >= 0.1)[-1]) + 1

    def inverse_link(self, u: np.ndarray) -> np.ndarray:
        """Return c_in/ĉ_bh (..., n_inlet) for u of the same shape."""
        return 1.0 + u if self.link == "linear" else np.exp(u)

    def derivative_by_x(self, by_ratio: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return derivatives (m, K, r) by x (K, r) from those by c_in/ĉ_bh (m, K, n_inlet)."""
        if self.link == "logarithm":
            by_ratio = by_ratio * np.exp(x @ self.modes.T)
        # one product of two-dimensional arrays is faster than many small products
        by_x = by_ratio.reshape(-1, len(self.modes)) @ self.modes
        return by_x.reshape(*by_ratio.shape[:2], -1)

    def time_covariance(self, steps: int) -> np.ndarray:
        """Return the covariance (steps,) of an entry of x at lags of 0 … steps − 1 time steps."""
        entries = np.zeros(steps)
        known = min(steps, len(self.correlation))
        entries[:known] = self.correlation[:known]
        return entries

    def matches_task(self, task: Task) -> bool:
        """Return whether the prior is for this task's inlet and time step."""
        there = task.mesh.points[task.transport.inlet]
        return (there.shape == self.points.shape
                and bool(np.allclose(there, self.points, atol=NODE_ATOL_M))
                and bool(np.isclose(self.time_step, task.transport.time_step)))

    def check_task(self, task: Task) -> None:
        """Raise ``ValueError`` if the prior is for another inlet or another time step."""
        if not self.matches_task(task):
            raise ValueError(
                f"the prior must be for the task's inlet, {len(task.transport.inlet)} nodes in "
                f"steps of {task.transport.time_step:g} s; got one for {len(self.points)} nodes in "
                f"steps of {self.time_step:g} s; fit one with `eitbench fit prior`")

    def save(self, path: Path) -> None:
        """Write a file that `load` reads."""
        regimes = {} if self.regimes is None else {
            "regimes": {key: _rounded(getattr(self.regimes, name))
                        for name, key in REGIME_KEYS.items()}}
        text = json.dumps({
            "link": self.link, "time_step": self.time_step, "source": dict(self.source), **regimes,
            "correlation": _rounded(self.correlation), "points": _rounded(self.points),
            "modes": _rounded(self.modes)})
        write_atomically(path, (text + "\n").encode())

    @classmethod
    def load(cls, path: Path) -> InflowPrior:
        """Load a file that `save` wrote; ``ValueError`` naming the file if it is not valid."""
        try:
            said = json.loads(path.read_text(encoding="utf-8"))
            regimes = said.pop("regimes", None)
            return cls(**said, regimes=None if regimes is None else Regimes(
                **{name: regimes[key] for name, key in REGIME_KEYS.items()}))
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise ValueError(f"{path} must be a prior of `eitbench fit prior`: {error}") from None


def fit_inflow_prior(ratios: np.ndarray, points: np.ndarray, time_step: float, *,
                     link: str = "logarithm", nugget: float = 0.01, variance_cutoff: float = 1e-4,
                     quiet_threshold: float | None = None,
                     source: Mapping[str, Any] | None = None) -> InflowPrior:
    """Fit a prior to sampled inflows.

    Γ_across is the mean of u uᵀ over all times. The correlation at lag k is the sum of products at
    that lag, divided by the number of all steps and tapered to zero (Wendland 1995), so that it is
    a valid covariance for every sample.

    Parameters
    ----------
    ratios : (N, T, n_inlet)
        c_in relative to the background, > 0, of N episodes.
    points, time_step, link, source
        As in `InflowPrior`.
    nugget : float
        Fraction of the variance that is white in time, for unmodelled variation.
    variance_cutoff : float
        Modes across the inlet with a smaller fraction of the variance are dropped.
    quiet_threshold : float, optional
        Fit `Regimes` too: a step is quiet if |u| is less than this at all nodes.
    """
    ratios = _check.array("ratios", ratios, (None, None, len(points)))
    _check.number("nugget", nugget, low=0.0, high=1.0)
    _check.number("variance_cutoff", variance_cutoff, low=0.0, high=1.0)
    N, T, _ = ratios.shape
    if not N or T < MIN_STEPS:
        raise ValueError(f"ratios must be of at least one episode of {MIN_STEPS} steps, got {N} of "
                         f"{T}")
    if (ratios <= 0).any():
        raise ValueError(f"ratios must be above 0, got {ratios.min():g}")
    u = ratios - 1.0 if link == "linear" else np.log(ratios)
    if not u.any():
        raise ValueError("ratios must vary, got constant inflows")
    values, vectors = np.linalg.eigh(np.einsum("nti,ntj->ij", u, u) / (N * T))
    keep = values > variance_cutoff * values.sum()
    modes = (vectors[:, keep] * np.sqrt(values[keep]))[:, ::-1]
    lags = np.arange(T // 2)
    products = np.array([(u[:, k:] * u[:, :T - k]).sum() for k in lags])
    taper = (1.0 - lags / len(lags))**4 * (1.0 + 4.0 * lags / len(lags))
    correlation = (1.0 - nugget) * taper * products / products[0]
    correlation[0] = 1.0
    regimes = None if quiet_threshold is None else _fit_regimes(u, quiet_threshold)
    return InflowPrior(link, points, modes, correlation, time_step, source or {}, regimes)


def _fit_regimes(u: np.ndarray, threshold: float) -> Regimes:
    """Return the regimes' parameters from u (N, T, n_inlet)."""
    _check.number("quiet_threshold", threshold, low=0.0, open_low=True)
    slug = np.abs(u).max(axis=2) >= threshold
    if slug.all() or not slug.any():
        raise ValueError(f"quiet_threshold must be exceeded in some steps only, got {threshold}"
                         f" where {slug.mean():.0%} do")
    before = slug[:, :-1]
    after = slug[:, 1:]
    variance = np.square(u).sum(axis=2)
    return Regimes(float(after[~before].mean()), float((~after[before]).mean()),
                   float(variance[~slug].mean() / variance[slug].mean()))


def fit_prior_from_episodes(world: World, seeds: Sequence[int], **how: Any) -> InflowPrior:
    """Fit a prior to the inflows of these episodes, without simulating the episodes.

    ``ValueError`` if the world has no inflow, or an episode is not of the split ``train``.
    """
    if others := [seed for seed in seeds if seed not in SPLITS["train"]]:
        raise ValueError("seeds must be of the split train, the only one for fitting; got "
                         f"{format_seed(others[0])}")
    inflows = np.array([world.sample_inflow(seed) for seed in seeds])
    mesh, inlet = world.vessel.transport_mesh(fine=False)
    return fit_inflow_prior(inflows / world.background, mesh.points[np.unique(inlet)],
                            world.time_step, **how)


def compatible_priors(folder: Path, task: Task, link: str) -> list[InflowPrior]:
    """Return the priors in a folder's files with this link, for this task's inlet and time step.

    Priors fitted in the task's world come first, then the others by file name. If several worlds
    have such an inlet and none of them is the task's, a message names the world of the first prior,
    since its inflow may differ from the task's.
    """
    priors = map(_load, sorted(folder.glob("*.json")))
    suiting = [prior for prior in priors if prior.link == link and prior.matches_task(task)]
    worlds = {source_world(prior.source) for prior in suiting}
    if len(worlds) > 1 and not worlds & nominal_worlds(task.world):
        _say_other_world(task.world, str(source_world(suiting[0].source)))
    return own_world_first(task, suiting)


_load = lru_cache(maxsize=16)(InflowPrior.load)  # once per process: caches can use its identity


def own_world_first(task: Task, fitted: list[Any]) -> list[Any]:
    """Return priors or models, those fitted in the task's world first."""
    own = nominal_worlds(task.world)
    return sorted(fitted, key=lambda each: source_world(each.source) not in own)


@lru_cache
def _say_other_world(world: str, learned: str) -> None:
    """Report once per process which prior replaces a missing one."""
    notify(f"no inflow prior was fitted in {world!r}: the prior of {learned} is used; "
           "fit one with `eitbench fit prior`")


def nominal_worlds(name: str) -> set[str]:
    """Return the name of a world and, if it is shifted, of its nominal world."""
    homes = {each.nominal for each in entries().values()
             if each.nominal and each.world.name == name}
    return {name} | {entries()[home].world.name for home in homes}


def source_world(source: Mapping[str, Any]) -> str | None:
    """Return the name of the world in a fitted object's provenance, or None."""
    where = entries().get(source.get("environment", ""))
    return None if where is None else where.world.name


def _rounded(array: np.ndarray) -> Any:
    """Return nested lists rounded to nine digits, below the sampling error."""
    return np.vectorize(lambda entry: float(f"{entry:.9g}"), otypes=[float])(array).tolist()
