"""Scores of an episode; a registered score appears in records, tables, CSV, pages and `compare`."""

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
"""Version of the run and the scores of an episode; raise it when the same method gets other scores
in the same episode. Results of other versions are not reused."""
SCORES_GROUP = "eitbench.scores"
"""Entry-point group of installed packages: each entry names a module that registers scores."""
SCORE_DIRECTIONS = ("lower", "higher", "nominal", "none")
"""Direction in which a score improves; nominal: towards the value in its explanation."""
LOST_DISTANCE = 0.04
"""m, distance beyond which a body counts as lost: more than its diameter"""
N_SECTIONS = 40
"""Number of equal sections along a pipe in which concentrations are averaged."""
KINDS = (*TRACKS, "measured")
"""Tracks with simulated truth, and measurements of a real instrument."""


@dataclass(frozen=True)
class Outcome:
    """Data of an episode from which scores are computed: S scored states at the m nodes of the
    truth mesh. A field is None where the episode or the track does not have it."""

    world: World | None
    """None for measurements"""
    seconds_per_step: float
    """s, of the method on one core"""
    errors: np.ndarray
    """(S,) ẽ_c (5.12) of each state; for measurements, the mean square of `prediction_error`"""
    n_injections: int | None = None
    """number of injections of a policy"""
    mean: np.ndarray | None = None
    """(S, m) mol/m³"""
    truth: np.ndarray | None = None
    """(S, m) mol/m³"""
    mass: Any = None
    """(m, m) sparse mass matrix of the scored region, m² (m³ in 3D)"""
    points: np.ndarray | None = None
    """(m, d) m"""
    homogeneous: float | None = None
    """mol/m³, the homogeneous concentration that fits all measurements best"""
    voltages_measured: np.ndarray | None = None
    """(S, L) V"""
    voltages_predicted: np.ndarray | None = None
    """(S, L) V, of the estimates"""
    innovations: tuple[np.ndarray | list[np.ndarray], np.ndarray | list[np.ndarray]] | None = None
    """(K, L) V and their covariances (K, L, L) V², if reported; where measurements were rejected,
    two lists of K arrays (m,) and (m, m) of the m accepted ones"""
    std: np.ndarray | None = None
    """(S, m) mol/m³, if every scored state has a variance"""
    velocity: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    """(S, p) estimated and true m/s, and weights (p,), where the task includes the flow"""
    solute_flow: tuple[np.ndarray, np.ndarray] | None = None
    """(S,) estimated and true flow of solute through a pipe's outlet, mol/s (mol/(s·m) in 2D)"""
    solute_flow_std: np.ndarray | None = None
    """(S,) standard deviation of the estimated flow, if reported in every scored state"""
    sections: tuple[np.ndarray, np.ndarray] | None = None
    """(S, q) estimated and true mean concentration of each of `N_SECTIONS` sections, mol/m³"""
    section_covariance: np.ndarray | None = None
    """(S, q, q) (mol/m³)², covariance of the former, if reported in every scored state"""
    distances: np.ndarray | None = None
    """m, between the estimated and the true position of each body in each scored state"""
    ospa: float | None = None
    """m, `scoring.ospa` of the bodies with the cutoff `LOST_DISTANCE`"""
    areas: tuple[np.ndarray, np.ndarray] | None = None
    """(S,) m², estimated and true total area of the bodies, if there is one in a scored state"""
    mean_nis: float | None = None
    """NIS/m of measurements"""
    ktc: float | None = None
    """score of the Kuopio Tomography Challenge, where the true segmentation is known"""

    @property
    def weights(self) -> np.ndarray:
        """(m,) area (volume in 3D) of each node: the row sums of ``mass``."""
        return np.asarray(self.mass.sum(axis=0)).ravel()


@dataclass(frozen=True)
class Score:
    """A number computed from each episode; ``ValueError`` if a field is invalid."""

    name: str
    """Key in records and CSV: lower-case letters, digits, underscores."""
    heading: str
    explanation: str
    """Description for readers of a table, with the unit."""
    compute: Callable[[Any], float | None]
    """Maps an `Outcome` to a number, or to None where the score is undefined."""
    direction: str = "lower"
    """One of `SCORE_DIRECTIONS`."""
    requires: Sequence[str] = ()
    """Fields of `Outcome` without which the score is None."""
    tracks: Sequence[str] = ("estimation",)
    """Subset of `KINDS`."""
    factor: float = 1.0
    """Factor of displayed values: 1e3 for seconds in ms."""
    deterministic: bool = True
    """True if a rerun of the episode gives the same number; false for times."""
    rounding: float = 0.0
    """Difference that rounding may cause in a rerun, as in a fraction of nodes that are counted."""

    def __post_init__(self) -> None:
        if not self.name.isidentifier() or self.name != self.name.lower() or self.name[0] == "_":
            raise ValueError("name must be of lower-case letters, digits and underscores, got "
                             f"{self.name!r}")
        _check.choice("direction", self.direction, SCORE_DIRECTIONS)
        for each in self.requires:
            _check.choice("each of requires", each, Outcome.__dataclass_fields__)
        for each in self.tracks:
            _check.choice("each of tracks", each, KINDS)
        _check.number("factor", self.factor, low=0.0, open_low=True)
        _check.number("rounding", self.rounding, low=0.0)

    def __call__(self, outcome: Outcome) -> float | None:
        """Compute the score of an episode; None if a required field is missing or the score is
        undefined. ``ValueError`` if the result is not a finite number."""
        if any(getattr(outcome, field) is None for field in self.requires):
            return None
        value = self.compute(outcome)
        if value is None:
            return None
        _check.number(f"score {self.name}", float(value))
        return value if isinstance(value, int) else float(value)


_initialise = Score.__init__


def _accept_old_keywords(score: Score, *args: Any, **fields: Any) -> None:
    """Initialise a score, also with the former names of its fields, as third-party packages do."""
    names = {"of": "compute", "better": "direction", "needs": "requires",
             "repeats": "deterministic"}
    _initialise(score, *args, **{names.get(name, name): value for name, value in fields.items()})


Score.__init__ = _accept_old_keywords  # type: ignore[assignment]
_scores: dict[str, Score] = {}


def register_score(score: Score) -> Score:
    """Add a score to all episodes from now on; ``ValueError`` if its name or heading is in use."""
    for other in _scores.values():
        if other.name == score.name or other.heading == score.heading:
            raise ValueError(f"score {score.name} ({score.heading}) has the name or heading of "
                             f"another, {other.name} ({other.heading})")
    _scores[score.name] = score
    return score


def scores(track: str | None = None) -> dict[str, Score]:
    """Map names to the scores of one of `KINDS`, or of all tracks, in the order of tables: built-in
    scores, scores of installed packages, then other registered ones."""
    _load_installed()
    kinds = set(TRACKS) if track is None else {track}
    return {name: each for name, each in _scores.items() if kinds & set(each.tracks)}


@lru_cache(maxsize=1)
def _load_installed() -> None:
    for point in entry_points(group=SCORES_GROUP):
        try:
            point.load()
        except Exception as error:          # a third-party package must not break this one
            warnings.warn(f"scores of {point.value} are skipped: {type(error).__name__}: {error}",
                          stacklevel=2)


def compute_scores(track: str, outcome: Outcome) -> dict[str, float | None]:
    """Compute all scores of an episode of a track, or of measurements."""
    kind = "measured" if outcome.world is None else track
    return {name: each(outcome) for name, each in scores(kind).items()}


def _relative_rms(estimated: np.ndarray, true: np.ndarray) -> float:
    return float(np.sqrt(((estimated - true)**2).sum() / (true**2).sum()))


def _solute_flow_coverage(outcome: Any) -> float:
    estimated, true, std = (each[:, None] for each in
                            (*outcome.solute_flow, outcome.solute_flow_std))
    return scoring.coverage(estimated, std, true, np.ones(1), 0.9)


def _slug_error(outcome: Any, which: int) -> float | None:
    """Error of arrival (0) or duration (1) in s."""
    errors = scoring.slug_errors(*outcome.solute_flow)
    return None if errors is None else outcome.world.time_step * errors[which]


def _nis(outcome: Any) -> float | None:
    """Mean of νᵀS⁻¹ν/m over injections, with the m accepted measurements of each."""
    if outcome.innovations is None:
        return outcome.mean_nis
    innovations, covariances = outcome.innovations
    if isinstance(innovations, np.ndarray):         # one call: the rounding of published records
        return float(scoring.normalised_innovations(innovations, covariances).mean())
    each = [scoring.normalised_innovations(innovation[None], covariance[None])[0]
            for innovation, covariance in zip(innovations, covariances, strict=True)]
    return float(np.mean(each))


def _uncertainty(outcome: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the arguments of the functions in `scoring` for the reported uncertainty."""
    return outcome.mean, outcome.std, outcome.truth, outcome.weights


for _score in (
    Score("error", "ẽ_c", "relative estimation error (5.12)",
          lambda outcome: outcome.errors.mean(), tracks=KINDS),
    Score("prediction_error", "withheld RMSE",
          "RMS residual of withheld measurements relative to the standard deviation of their "
          "noise; 1 is the noise level",
          lambda outcome: float(np.sqrt(outcome.errors.mean())), tracks=("measured",)),
    Score("ktc", "KTC",
          "score of the Kuopio Tomography Challenge 2023: similarity of the estimate's and the "
          "true segmentation, 1 if equal",
          lambda outcome: outcome.ktc, direction="higher", tracks=("measured",)),
    Score("contrast_error", "contrast",
          "error relative to the deviation of the truth from the homogeneous estimate of the whole "
          "episode, which has 1",
          lambda outcome: scoring.relative_error(outcome.mean, outcome.truth, outcome.mass,
                                                 reference=outcome.homogeneous),
          requires=("mean", "truth")),
    Score("nis", "NIS/m",
          "normalised innovation squared of all scored measurements; 1 if the filter's uncertainty "
          "is calibrated",
          _nis, direction="nominal", tracks=KINDS),
    Score("crps", "CRPS", "continuous ranked probability score, mol/m³",
          lambda outcome: scoring.crps(*_uncertainty(outcome)), requires=("std",), tracks=TRACKS),
    Score("velocity_error", "ẽ_v",
          "relative error of the flow, ∫(v̂ − v)²/∫v² across the pipe, where the task includes the "
          "flow",
          lambda outcome: scoring.relative_error(outcome.velocity[0], outcome.velocity[1],
                                                 np.diag(outcome.velocity[2])),
          requires=("velocity",)),
    Score("solute_flow_error", "flow error",
          "relative RMS error of the solute flow through the outlet, ∫ĉ v̂·n against ∫c v·n",
          lambda outcome: _relative_rms(*outcome.solute_flow), requires=("solute_flow",)),
    Score("solute_flow_coverage_90", "flow 90 %",
          "fraction of time in which the reported 90 % interval of the solute flow through the "
          "outlet contains the truth",
          _solute_flow_coverage, direction="nominal", requires=("solute_flow_std",)),
    Score("solute_amount_error", "amount error",
          "relative error of the amount of solute that leaves the pipe during the scored states",
          lambda outcome: abs(outcome.solute_flow[0].sum() / outcome.solute_flow[1].sum() - 1.0),
          requires=("solute_flow",)),
    Score("section_error", "section error",
          f"relative RMS error of the mean concentration in each of {N_SECTIONS} equal sections "
          "along the pipe",
          lambda outcome: _relative_rms(*outcome.sections), requires=("sections",)),
    Score("energy_score", "energy score",
          "energy score of the joint density of the mean concentrations in these sections, mol/m³",
          lambda outcome: scoring.energy_score(outcome.sections[0], outcome.section_covariance,
                                               outcome.sections[1]),
          requires=("section_covariance",)),
    Score("arrival_error", "arrival",
          "mean error of the arrival of slugs at the outlet, ms; a missed slug counts its duration",
          lambda outcome: _slug_error(outcome, 0), requires=("solute_flow",), factor=1e3),
    Score("duration_error", "duration",
          "mean error of the duration of slugs at the outlet, ms; a missed slug counts its "
          "duration",
          lambda outcome: _slug_error(outcome, 1), requires=("solute_flow",), factor=1e3),
    Score("position_error", "position",
          "median distance between the estimated and the true position of a body, mm",
          lambda outcome: float(np.median(outcome.distances)), requires=("distances",),
          tracks=("injection",), factor=1e3),
    Score("lost_fraction", "lost",
          f"fraction of the states with a body whose estimated position is off by more than "
          f"{1e3 * LOST_DISTANCE:g} mm",
          lambda outcome: float((outcome.distances > LOST_DISTANCE).mean()),
          requires=("distances",), tracks=("injection",)),
    Score("ospa", "OSPA",
          f"OSPA distance of a body's estimate (Schuhmacher et al. 2008, order 2), mm: RMS over "
          f"the states of the position error, at most {1e3 * LOST_DISTANCE:g} mm; a missed or a "
          f"false body counts as much",
          lambda outcome: outcome.ospa, tracks=("injection",), factor=1e3),
    Score("area_error", "area error",
          "relative RMS error of the total area of the bodies, which is the gas content of a pipe "
          "with bubbles",
          lambda outcome: _relative_rms(*outcome.areas), requires=("areas",),
          tracks=("injection",)),
    Score("coverage_50", "50 %", "fraction of the truth inside the reported 50 % interval",
          lambda outcome: scoring.coverage(*_uncertainty(outcome), 0.5),
          direction="nominal", requires=("std",), tracks=TRACKS, rounding=1e-4),
    Score("coverage_90", "90 %", "fraction of the truth inside the reported 90 % interval",
          lambda outcome: scoring.coverage(*_uncertainty(outcome), 0.9),
          direction="nominal", requires=("std",), tracks=TRACKS, rounding=1e-4),
    Score("spread_ratio", "var/MSE",
          "reported variance over mean squared error; 1 if calibrated, more if the uncertainty is "
          "overestimated",
          lambda outcome: scoring.spread_ratio(*_uncertainty(outcome)),
          direction="nominal", requires=("std",), tracks=TRACKS),
    Score("voltage_discrepancy", "ẽ_V", "voltage discrepancy (5.13), mV²; a diagnostic",
          lambda outcome: scoring.voltage_discrepancy(outcome.voltages_measured,
                                                      outcome.voltages_predicted),
          direction="none", requires=("voltages_measured", "voltages_predicted"), factor=1e6),
    Score("spent", "injections", "number of injections of the policy",
          lambda outcome: outcome.n_injections, direction="none", requires=("n_injections",),
          tracks=("injection",)),
    Score("seconds_per_step", "ms/step",
          "wall time per injection on one core, in the fastest episode; excludes computations that "
          "are done once for a model",
          lambda outcome: outcome.seconds_per_step, tracks=KINDS, factor=1e3,
          deterministic=False),
):
    register_score(_score)
