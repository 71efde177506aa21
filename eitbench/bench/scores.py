"""Scores of an episode; a registered one appears in records, tables, CSV, pages and `compare`."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import entry_points
from typing import Any

import numpy as np

from eitbench import _check, scoring
from eitbench.bench.tracks import TRACKS
from eitbench.worlds.world import World

SCORING = 1
"""Version of how an episode is run and scored; raise it when the same method on the same episode
gets other scores. Results of another version are not reused."""
GROUP = "eitbench.scores"
"""Entry points of installed packages: each names a module that registers scores."""
BETTER = ("lower", "higher", "nominal", "none")
"""Which way is better: less, more, nearer to what the explanation says; or neither."""
KINDS = (*TRACKS, "measured")
"""Tracks with simulated truth, and measurements of a real instrument."""


@dataclass(frozen=True)
class Outcome:
    """What can be scored of an episode: S scored states at the m nodes of the truth's mesh. What an
    episode or a track does not have is None."""

    world: World | None
    """None of measurements"""
    seconds_per_step: float
    """s, of the method on one core"""
    errors: np.ndarray
    """(S,) ẽ_c (5.12) of each state; of measurements, the mean square of `prediction_error`"""
    spent: int | None = None
    """injections that a policy made"""
    mean: np.ndarray | None = None
    """(S, m) mol/m³"""
    truth: np.ndarray | None = None
    """(S, m) mol/m³"""
    mass: Any = None
    """(m, m) sparse, m² (m³ in 3D): of what counts"""
    points: np.ndarray | None = None
    """(m, d) m"""
    homogeneous: float | None = None
    """mol/m³, the one level that fits all measurements best"""
    measured: np.ndarray | None = None
    """(S, L) V"""
    computed: np.ndarray | None = None
    """(S, L) V that the model computes of the estimates"""
    innovations: tuple[np.ndarray | list[np.ndarray], np.ndarray | list[np.ndarray]] | None = None
    """(K, L) V and their covariances (K, L, L) V², where claimed; two lists of K where not every
    reading is used: (m,) and (m, m) of the m that were"""
    std: np.ndarray | None = None
    """(S, m) mol/m³, where every scored state has a variance"""
    velocity: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    """(S, p) estimated and true m/s, and weights (p,), where the flow is asked for"""
    mean_nis: float | None = None
    """NIS/m of measurements"""
    ktc: float | None = None
    """score of the Kuopio Tomography Challenge, where a segmentation of the truth is known"""

    @property
    def weights(self) -> np.ndarray:
        """(m,) area (volume in 3D) that each node stands for."""
        return np.asarray(self.mass.sum(axis=0)).ravel()


@dataclass(frozen=True)
class Score:
    """A number by which an episode is scored; ``ValueError`` if a field is invalid."""

    name: str
    """in records and CSV: lower-case letters, digits, underscores"""
    heading: str
    explanation: str
    """for readers of a table, with the unit"""
    of: Callable[[Any], float | None]
    """Outcome -> number, or None where it has no meaning"""
    better: str = "lower"
    """One of `BETTER`."""
    needs: Sequence[str] = ()
    """Fields of `Outcome` without which the score is None."""
    tracks: Sequence[str] = ("estimation",)
    """Among `KINDS`."""
    factor: float = 1.0
    """Factor of displayed values: 1e3 for seconds in ms."""
    repeats: bool = True
    """Whether the same episode gives the same number, unlike times."""

    def __post_init__(self) -> None:
        if not self.name.isidentifier() or self.name != self.name.lower() or self.name[0] == "_":
            raise ValueError("name must be of lower-case letters, digits and underscores, got "
                             f"{self.name!r}")
        if self.better not in BETTER:
            raise ValueError(f"better must be one of {', '.join(BETTER)}, got {self.better!r}")
        for argument, given, known in (("needs", self.needs, Outcome.__dataclass_fields__),
                                       ("tracks", self.tracks, KINDS)):
            if unknown := [each for each in given if each not in known]:
                raise ValueError(f"{argument} must be among {', '.join(known)}; got "
                                 f"{', '.join(map(repr, unknown))}")
        _check.number("factor", self.factor, low=0.0, open_low=True)

    def __call__(self, outcome: Outcome) -> float | None:
        """Compute the score of an episode; None if a field is missing or the score has no meaning.
        ``ValueError`` if it is not a finite number."""
        if any(getattr(outcome, need) is None for need in self.needs):
            return None
        value = self.of(outcome)
        if value is None:
            return None
        _check.number(f"score {self.name}", float(value))
        return value if isinstance(value, int) else float(value)


_scores: dict[str, Score] = {}


def register_score(score: Score) -> Score:
    """Add a score to those of all episodes that run from now on. ``ValueError`` if another has its
    name or heading."""
    for other in _scores.values():
        if other.name == score.name or other.heading == score.heading:
            raise ValueError(f"score {score.name} ({score.heading}) has the name or heading of "
                             f"another, {other.name} ({other.heading})")
    _scores[score.name] = score
    return score


def scores(track: str | None = None) -> dict[str, Score]:
    """Map names to the scores of one of `KINDS`, or of all tracks, in the order of tables: built-in
    ones, then those of installed packages and those registered by hand."""
    _load_installed()
    kinds = set(TRACKS) if track is None else {track}
    return {name: each for name, each in _scores.items() if kinds & set(each.tracks)}


@lru_cache(maxsize=1)
def _load_installed() -> None:
    for point in entry_points(group=GROUP):
        try:
            point.load()
        except Exception as error:          # a third-party package must not break this one
            warnings.warn(f"scores of {point.value} are left out: {type(error).__name__}: {error}",
                          stacklevel=2)


def scored(track: str, outcome: Outcome) -> dict[str, float | None]:
    """Compute all scores of an episode of a track, or of measurements."""
    kind = "measured" if outcome.world is None else track
    return {name: each(outcome) for name, each in scores(kind).items()}


def _contrast(outcome: Any) -> float:
    return scoring.relative_error(outcome.mean, outcome.truth, outcome.mass,
                                  reference=outcome.homogeneous)


def _of_velocity(outcome: Any) -> float:
    estimated, true, weights = outcome.velocity
    return scoring.relative_error(estimated, true, np.diag(weights))


def _nis(outcome: Any) -> float | None:
    """The mean of νᵀS⁻¹ν/m, m being the readings that were used each time."""
    if outcome.innovations is None:
        return outcome.mean_nis
    innovations, covariances = outcome.innovations
    if isinstance(innovations, np.ndarray):                     # all at once: the same bits as ever
        return float(scoring.normalised_innovations(innovations, covariances).mean())
    each = [scoring.normalised_innovations(innovation[None], covariance[None])[0]
            for innovation, covariance in zip(innovations, covariances, strict=True)]
    return float(np.mean(each))


def _claimed(outcome: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the arguments of `scoring` for a reported uncertainty."""
    return outcome.mean, outcome.std, outcome.truth, outcome.weights


for _score in (
    Score("error", "ẽ_c", "relative estimation error (5.12)",
          lambda outcome: outcome.errors.mean(), tracks=KINDS),
    Score("prediction_error", "withheld RMSE",
          "RMS residual of withheld readings relative to the standard deviation of their noise; 1 "
          "is the noise level",
          lambda outcome: float(np.sqrt(outcome.errors.mean())), tracks=("measured",)),
    Score("ktc", "KTC",
          "score of the Kuopio Tomography Challenge 2023: similarity of the estimate's and the "
          "true segmentation, 1 if equal",
          lambda outcome: outcome.ktc, better="higher", tracks=("measured",)),
    Score("contrast_error", "contrast",
          "error relative to the deviation from the homogeneous estimate; 1 is no better than that",
          _contrast, needs=("mean", "truth")),
    Score("nis", "NIS/m",
          "normalised innovation squared, of all scored measurements; 1 when the filter's own "
          "uncertainty fits",
          _nis, better="nominal", tracks=KINDS),
    Score("crps", "CRPS", "continuous ranked probability score, mol/m³",
          lambda outcome: scoring.crps(*_claimed(outcome)), needs=("std",), tracks=TRACKS),
    Score("velocity_error", "ẽ_v",
          "relative error of the flow, ∫(v̂ − v)²/∫v² across the pipe, where it is asked for too",
          _of_velocity, needs=("velocity",)),
    Score("coverage_50", "50 %", "part of the truth inside the claimed 50 % interval",
          lambda outcome: scoring.coverage(*_claimed(outcome), 0.5),
          better="nominal", needs=("std",), tracks=TRACKS),
    Score("coverage_90", "90 %", "part of the truth inside the claimed 90 % interval",
          lambda outcome: scoring.coverage(*_claimed(outcome), 0.9),
          better="nominal", needs=("std",), tracks=TRACKS),
    Score("spread_ratio", "var/MSE",
          "claimed variance over squared error; 1 is honest, more is too modest",
          lambda outcome: scoring.spread_ratio(*_claimed(outcome)),
          better="nominal", needs=("std",), tracks=TRACKS),
    Score("voltage_discrepancy", "ẽ_V", "voltage discrepancy (5.13), mV²; a diagnostic",
          lambda outcome: scoring.voltage_discrepancy(outcome.measured, outcome.computed),
          better="none", needs=("measured", "computed"), factor=1e6),
    Score("spent", "injections", "how many the policy made, where it is asked for them",
          lambda outcome: outcome.spent, better="none", needs=("spent",), tracks=("injection",)),
    Score("seconds_per_step", "ms/step",
          "time per injection on one core, in the fastest episode: what is done once for a model "
          "is left apart",
          lambda outcome: outcome.seconds_per_step, tracks=KINDS, factor=1e3,
          repeats=False),
):
    register_score(_score)
