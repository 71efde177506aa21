"""Scores as functions of arrays (``docs/methods.md``, 4). Lower is better unless stated otherwise;
`E` is the relative error (5.12)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri

ENERGY_DRAWS = 100
"""Number of random draws of `energy_score`; each is used with both signs."""


def step_errors(estimate: np.ndarray, truth: np.ndarray, mass: Any,
                reference: float = 0.0) -> np.ndarray:
    """Compute (T,) ∫(ĉ_t − c_t)² / ∫(c_t − reference)² for nodal values (T, n) on the truth mesh.

    ``mass`` (n, n) is the mass matrix of that mesh, dense or sparse. With ``reference`` 0 these are
    the terms of (5.12), with the homogeneous estimate those for the contrast error.
    """
    estimate, truth = _pair(estimate, truth)
    return _squares(estimate - truth, mass) / _squares(truth - reference, mass)


def relative_error(estimate: np.ndarray, truth: np.ndarray, mass: Any,
                   reference: float = 0.0) -> float:
    """Compute ẽ_c = (1/T) Σ_t ∫(ĉ_t − c_t)² / ∫c_t² (thesis 5.12: squared, no root); arguments as
    in `step_errors`."""
    return float(step_errors(estimate, truth, mass, reference).mean())


def voltage_discrepancy(measured: np.ndarray, computed: np.ndarray) -> float:
    """Compute ẽ_V = 1/(T·N_V) Σ_t ‖V_t − V̂_t‖² in V² for (T, N_V) voltages (thesis 5.13)."""
    measured, computed = _pair(measured, computed)
    return float(((measured - computed)**2).mean())


def normalised_innovations(innovation: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Compute NIS/m at each t, νᵀS⁻¹ν/m for innovations (T, m) and covariances (T, m, m); the mean
    is 1 for a consistent filter."""
    whitened = np.linalg.solve(covariance, innovation[..., None])[..., 0]
    return np.einsum("tm,tm->t", innovation, whitened) / innovation.shape[1]


def crps(mean: np.ndarray, std: np.ndarray, truth: np.ndarray, weights: np.ndarray) -> float:
    """Compute the continuous ranked probability score of Gaussian marginals (T, n), averaged over
    time and, with ``weights`` (n,), space.

    It has the unit of the truth; a zero ``std`` gives the absolute error (Gneiting & Raftery 2007).
    """
    mean, truth = _pair(mean, truth)
    error = np.abs(truth - mean)
    spread = np.maximum(std, 1e-12 * np.maximum(error, 1e-300))
    z = error / spread
    density = np.exp(-0.5 * np.minimum(z, 40.0)**2) / math.sqrt(2 * math.pi)
    gaussian = error * (2 * ndtr(z) - 1) + spread * (2 * density - 1 / math.sqrt(math.pi))
    score = np.where(std > 0, gaussian, error)
    return float(np.average(score.mean(axis=0), weights=weights))


def coverage(mean: np.ndarray, std: np.ndarray, truth: np.ndarray, weights: np.ndarray,
             level: float) -> float:
    """Compute the fraction of space and time in which the truth is in the central ``level``
    interval of the Gaussian marginal; arguments as in `crps`."""
    mean, truth = _pair(mean, truth)
    rounding = 1e-9 * np.abs(truth)    # decides where the estimate is exact and its std zero
    is_inside = np.abs(truth - mean) <= ndtri(0.5 + level / 2) * std + rounding
    return float(np.average(is_inside.mean(axis=0), weights=weights))


def spread_ratio(mean: np.ndarray, std: np.ndarray, truth: np.ndarray,
                 weights: np.ndarray) -> float:
    """Compute the mean variance divided by the mean squared error; 1 for calibrated uncertainty,
    more if it is overestimated."""
    mean, truth = _pair(mean, truth)
    variance = np.average((std**2).mean(axis=0), weights=weights)
    return float(variance / np.average(((mean - truth)**2).mean(axis=0), weights=weights))


def energy_score(mean: np.ndarray, covariance: np.ndarray, truth: np.ndarray) -> float:
    """Compute the mean over time of E‖x − y‖ − ½ E‖x − x'‖ for a joint Gaussian density of x and x'
    with ``mean`` (T, q) and ``covariance`` (T, q, q), y = ``truth`` (T, q), and the norm
    (Σ x²/q)^½; it has the unit of the truth (Gneiting & Raftery 2007).

    Unlike `crps` it depends on the correlations. The expectations are means over `ENERGY_DRAWS`
    draws, the same in every call.
    """
    mean, truth = _pair(mean, truth)
    q = mean.shape[1]
    draws = np.random.default_rng(0).standard_normal((ENERGY_DRAWS, q))
    draws = np.concatenate([draws, -draws])
    variances, axes = np.linalg.eigh(covariance)
    # the symmetric root does not depend on the signs of the axes
    roots = (axes * np.sqrt(np.maximum(variances, 0.0))[:, None]) @ axes.swapaxes(1, 2)
    moves = draws @ roots
    error = np.linalg.norm((mean - truth)[:, None] + moves, axis=2).mean()
    spread = math.sqrt(2) * np.linalg.norm(moves, axis=2).mean()       # x − x' ~ N(0, 2 P)
    return float((error - 0.5 * spread) / math.sqrt(q))


def slug_errors(estimated: np.ndarray, true: np.ndarray) -> tuple[float, float] | None:
    """Compute the mean errors of arrival and duration, in steps, of the slugs in a ``true`` flow
    through a section (T,) and an ``estimated`` one; None without a complete slug.

    A slug is an interval in which the flow is above or below its median over time by more than half
    of the largest true deviation. Its counterpart is the estimated slug of the same sign with
    the largest overlap. An error is at most the true duration, which a missed slug has.
    """
    level = 0.5 * np.abs(true - np.median(true)).max()
    found = _slugs(estimated, level)
    errors = list[tuple[float, float]]()
    for begin, end, sign in _slugs(true, level):
        overlaps = [(min(end, other_end) - max(begin, other), other, other_end)
                    for other, other_end, other_sign in found if other_sign == sign]
        overlap, other, other_end = max(overlaps, default=(0.0, 0.0, 0.0))
        most = end - begin
        late, longer = abs(other - begin), abs(other_end - other - most)
        errors.append((min(late, most), min(longer, most)) if overlap > 0 else (most, most))
    if not errors:
        return None
    arrival, duration = np.mean(errors, axis=0)
    return float(arrival), float(duration)


def _slugs(flow: np.ndarray, level: float) -> list[tuple[float, float, int]]:
    """Return begin and end, in steps, and the sign of each complete interval in which a flow (T,)
    deviates from its median by more than ``level``, between linearly interpolated crossings."""
    slugs = []
    for sign in (1, -1):
        above = sign * (flow - np.median(flow)) - level
        inside = above > 0
        before = np.flatnonzero(inside[1:] != inside[:-1])
        crossings = before + above[before] / (above[before] - above[before + 1])
        first = int(inside[0])                      # its begin was not observed
        slugs += [(begin, end, sign)
                  for begin, end in zip(crossings[first::2], crossings[first + 1::2], strict=False)]
    return slugs


def normalised_score(error: float, homogeneous: float, reference: float) -> float:
    """Compute (E_bh − E)/(E_bh − E_ref): 0 for the homogeneous estimate, 1 for the reference;
    higher is better."""
    return (homogeneous - error) / (homogeneous - reference)


def deficit_centroid(values: np.ndarray, points: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Compute the centroid (d,) in m of the deficit median − value where it exceeds half its
    maximum, from nodal ``values`` (n,), ``points`` (n, d) in m and ``weights`` (n,), the areas of
    the nodes (row sums of the mass matrix).
    """
    deficit = np.median(values) - values
    counted = weights * np.where(deficit > 0.5 * deficit.max(), deficit, 0.0)
    if not counted.any():                                # a constant field has no minimum
        counted = weights
    centre: np.ndarray = counted @ points / counted.sum()
    return centre


def ospa(estimates: np.ndarray, estimated: np.ndarray, truths: np.ndarray, present: np.ndarray,
         cutoff: float) -> float:
    """Compute the root mean square of the OSPA distance in m over T states (Schuhmacher, Vo & Vo,
    IEEE Trans. Signal Process. 56, 2008, order 2).

    In a state, n is the larger of the numbers of bodies that are ``estimated`` to be present
    (T, k) and that are ``present`` (T, k). The distance is the root of the mean over n of the
    squared position errors, at most ``cutoff`` in m, of ``estimates`` and ``truths`` (T, k, d) in m
    after the best assignment, and of the squared cutoff for each missed or false body.
    """
    squares = []
    for claimed, exists, estimate, truth in zip(estimated, present, estimates, truths,
                                                strict=True):
        matched = _matched(estimate[claimed], truth[exists], cutoff)
        n = max(claimed.sum(), exists.sum())
        squares.append(((matched**2).sum() + (n - len(matched)) * cutoff**2) / max(n, 1))
    return math.sqrt(np.mean(squares))


def matched_distances(estimates: np.ndarray, truths: np.ndarray,
                      present: np.ndarray) -> np.ndarray:
    """Compute the distances (n,) in m of all ``present`` bodies (T, k) from the ``estimates``, with
    the best assignment of all estimates in each state; arguments as in `ospa`."""
    return np.concatenate([_matched(estimate, truth[exists]) for estimate, truth, exists
                           in zip(estimates, truths, present, strict=True)])


def _matched(estimates: np.ndarray, truths: np.ndarray, cutoff: float = np.inf) -> np.ndarray:
    """Return the distances, at most ``cutoff``, of the assignment with the least sum of squares."""
    from scipy.optimize import linear_sum_assignment  # lazy import: takes half a second
    distances = np.minimum(np.linalg.norm(estimates[:, None] - truths, axis=-1), cutoff)
    return np.asarray(distances[linear_sum_assignment(distances**2)])


def _pair(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a = np.asarray(a, dtype=float)
    b = np.asarray(b, dtype=float)
    if a.shape != b.shape or a.ndim != 2:
        raise ValueError("both arrays must have the same shape (T, n), got "
                         f"{a.shape} and {b.shape}")
    return a, b


def _squares(field: np.ndarray, mass: Any) -> np.ndarray:
    return np.einsum("tn,nt->t", field, mass @ field.T)
