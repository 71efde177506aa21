"""Scores against integrals by hand, definitions by quadrature, and random draws."""

import itertools

import numpy as np
import pytest
from eitbench.numerics.fem import mass_matrix
from eitbench.numerics.mesh import rectangle_mesh
from eitbench.scoring import (
    coverage,
    crps,
    deficit_centroid,
    energy_score,
    matched_distances,
    normalised_innovations,
    normalised_score,
    ospa,
    relative_error,
    slug_errors,
    spread_ratio,
    step_errors,
    voltage_discrepancy,
)
from scipy.integrate import quad
from scipy.stats import norm


@pytest.fixture(scope="module")
def square():
    """Return nodes x, y and the mass matrix of an uneven mesh of [0, 2] × [0, 1]."""
    mesh = rectangle_mesh([0.0, 0.3, 1.1, 2.0], [0.0, 0.2, 0.9, 1.0])
    return *mesh.points.T, mass_matrix(mesh)


def test_relative_error_is_the_mean_of_ratios(square):
    """(1/T) Σ_t ∫(ĉ − c)²/∫c² with exact integrals: ¼ with the truth x and the error y on [0, 2] × [0, 1], 1 with the
    truth y, (0.5/2)² for constants; not the ratio of sums."""
    x, y, mass = square
    truth, estimate = np.stack([x, y, 0 * x + 2]), np.stack([x + y, 2 * y, 0 * x + 2.5])
    np.testing.assert_allclose(step_errors(estimate, truth, mass), [0.25, 1.0, 0.0625], rtol=1e-13)
    assert relative_error(estimate, truth, mass) == pytest.approx(1.3125 / 3, rel=1e-13)


def test_contrast_form_measures_against_the_homogeneous_estimate(square):
    """For truth 5 + x and reference 5 the denominator is ∫x², and the homogeneous estimate scores 1."""
    x, y, mass = square
    truth = (5.0 + x)[None]
    assert relative_error(truth + y, truth, mass, reference=5.0) == pytest.approx(0.25, rel=1e-13)
    assert relative_error(np.full_like(truth, 5.0), truth, mass, reference=5.0) == pytest.approx(1.0, rel=1e-13)
    assert relative_error(truth + y, truth, mass) < 0.02


def test_voltage_discrepancy_is_a_mean_square():
    """1/(T·N_V) Σ‖V − V̂‖²: (1 + 4 + 0 + 0 + 0 + 4)/(2·3)."""
    measured = np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]])
    computed = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, 2.0]])
    assert voltage_discrepancy(measured, computed) == pytest.approx(1.5, rel=1e-15)


def test_innovations_of_their_own_covariance_average_one():
    """NIS/m of 4000 correlated Gaussian draws is 1 ± 0.05 (5 sigma); a halved covariance doubles it exactly."""
    rng = np.random.default_rng(0)
    T, m = 4000, 5
    root = rng.normal(size=(T, m, m))
    covariance = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(m)
    innovation = (np.linalg.cholesky(covariance) @ rng.normal(size=(T, m, 1)))[..., 0]
    nis = normalised_innovations(innovation, covariance)
    assert nis.shape == (T,)
    assert nis.mean() == pytest.approx(1.0, abs=5 * np.sqrt(2 / (m * T)))
    np.testing.assert_allclose(normalised_innovations(innovation, covariance / 2), 2 * nis, rtol=1e-9)
    assert nis[7] == pytest.approx(innovation[7] @ np.linalg.inv(covariance[7]) @ innovation[7] / m, rel=1e-9)


def test_crps_is_the_integral_of_its_definition():
    """∫ (Φ((s − mean)/std) − 1[s ≥ truth])² ds by quadrature; mean over time and weighted space."""
    mean, std = np.array([[0.0, 1.0], [-3.0, 2.0]]), np.array([[1.0, 0.5], [2.0, 0.3]])
    truth, weights = np.array([[0.0, 2.2], [-9.0, 1.9]]), np.array([1.0, 3.0])
    below, above = np.empty((2, 2)), np.empty((2, 2))
    for place in np.ndindex(2, 2):
        here = norm(mean[place], std[place])
        below[place], _ = quad(lambda s, here=here: here.cdf(s)**2, -np.inf, truth[place])
        above[place], _ = quad(lambda s, here=here: here.sf(s)**2, truth[place], np.inf)
    expected = (below + above).mean(axis=0) @ weights / 4
    assert crps(mean, std, truth, weights) == pytest.approx(expected, rel=1e-6)


def test_crps_without_spread_is_the_absolute_error():
    """The CRPS of a point forecast is its absolute error, also next to forecasts with a std; no warning is raised."""
    mean, truth = np.array([[1.0, 2.0]]), np.array([[4.0, 2.0]])
    with np.errstate(all="raise", under="ignore"):
        assert crps(mean, np.zeros((1, 2)), truth, np.array([3.0, 1.0])) == pytest.approx(2.25, rel=1e-14)
    tiny = crps(mean, np.full((1, 2), 1e-9), truth, np.array([3.0, 1.0]))
    assert tiny == pytest.approx(2.25, abs=1e-8)


@pytest.mark.parametrize("level", [0.5, 0.9])
def test_calibrated_gaussians_have_the_nominal_coverage(level):
    """Truth drawn from the forecast: coverage is the level within five binomial deviations; twice the std is more."""
    rng = np.random.default_rng(2)
    mean, std = rng.normal(size=(200, 300)), rng.uniform(0.5, 2.0, (200, 300))
    truth, weights = mean + std * rng.normal(size=mean.shape), np.ones(300)
    deviation = np.sqrt(level * (1 - level) / mean.size)
    assert coverage(mean, std, truth, weights, level) == pytest.approx(level, abs=5 * deviation)
    assert coverage(mean, 2 * std, truth, weights, level) == pytest.approx(2 * norm.cdf(2 * norm.ppf((1 + level) / 2))
                                                                           - 1, abs=5 * deviation)


def test_coverage_at_single_nodes():
    """Rounding does not decide without uncertainty: 0.1 + 0.2 and 0.3 agree, 0.3001 does not. With weights, the truth
    lies inside 90 % of a unit Gaussian (±1.645) at one node, at the other outside."""
    mean, truth = np.array([[0.1 + 0.2, 0.3001]]), np.full((1, 2), 0.3)
    assert coverage(mean, np.zeros((1, 2)), truth, np.ones(2), 0.9) == pytest.approx(0.5, rel=1e-14)
    mean, std, truth = np.zeros((1, 2)), np.ones((1, 2)), np.array([[1.64, -1.65]])
    assert coverage(mean, std, truth, np.array([3.0, 1.0]), 0.9) == pytest.approx(0.75, rel=1e-14)


def test_spread_ratio_compares_variance_with_squared_error():
    """The ratio is (3·1 + 1·4)/(3·4 + 1·16) = ¼ by hand, and 1 for calibrated Gaussians, 4 with twice the std."""
    mean, std, truth = np.zeros((1, 2)), np.array([[1.0, 2.0]]), np.array([[2.0, 4.0]])
    assert spread_ratio(mean, std, truth, np.array([3.0, 1.0])) == pytest.approx(0.25, rel=1e-14)
    rng = np.random.default_rng(3)
    mean, std = np.zeros((200, 300)), np.full((200, 300), 0.7)
    truth, weights = 0.7 * rng.normal(size=(200, 300)), np.ones(300)
    honest = spread_ratio(mean, std, truth, weights)
    assert honest == pytest.approx(1.0, abs=5 * np.sqrt(2 / mean.size))
    assert spread_ratio(mean, 2 * std, truth, weights) == pytest.approx(4 * honest, rel=1e-12)


def test_skill_runs_from_the_homogeneous_estimate_to_the_reference():
    """0 at E_bh, 1 at E_ref, linear between, negative beyond the homogeneous estimate."""
    values = [normalised_score(error, homogeneous=0.02, reference=0.004) for error in (0.02, 0.012, 0.004, 0.036)]
    assert values == pytest.approx([0.0, 0.5, 1.0, -1.0])


@pytest.mark.parametrize(("left", "right"), [((3, 4), (1, 4)), ((4,), (4,))])
@pytest.mark.parametrize("score", [
    lambda a, b: relative_error(a, b, np.eye(4)), voltage_discrepancy,
    lambda a, b: crps(a, np.ones_like(a), b, np.ones(4)), lambda a, b: coverage(a, np.ones_like(a), b, np.ones(4), 0.5),
    lambda a, b: spread_ratio(a, np.ones_like(a), b, np.ones(4)),
], ids=["relative_error", "voltage_discrepancy", "crps", "coverage", "spread_ratio"])
def test_arrays_must_be_a_pair_over_time_and_space(score, left, right):
    """Arrays are not broadcast: both are (T, n), or an error contains both shapes."""
    with pytest.raises(ValueError, match=r"same shape \(T, n\)"):
        score(np.ones(left), np.ones(right))


def test_ospa_of_several_bodies_is_that_of_the_best_assignment():
    """All assignments of the definition: of two, three and four bodies, in any order, missed and false ones."""
    random = np.random.default_rng(0)
    cutoff, squares, distances = 0.3, [], []
    states = [(random.uniform(size=(4, 2)), random.uniform(size=4) < 0.6, random.uniform(size=(4, 2)),
               random.uniform(size=4) < 0.6) for _ in range(30)]
    for estimate, claimed, truth, exists in states:
        few, many = sorted((estimate[claimed], truth[exists]), key=len)
        n = len(many)
        least = min((sum(min(np.hypot(*(a - many[k])), cutoff)**2 for a, k in zip(few, order, strict=False))
                     for order in itertools.permutations(range(n))), default=0.0)
        squares.append((least + cutoff**2 * (n - len(few))) / max(n, 1))
        true = truth[exists]
        best = min(itertools.permutations(range(4), len(true)),
                   key=lambda order: sum(((estimate[list(order)] - true)**2).sum(axis=1)))
        distances += np.hypot(*(estimate[list(best)] - true).T).tolist()
    estimates, claimed, truths, exists = (np.array(each) for each in zip(*states, strict=True))
    assert ospa(estimates, claimed, truths, exists, cutoff) == pytest.approx(np.mean(squares)**0.5, rel=1e-9)
    assert sorted(matched_distances(estimates, truths, exists)) == pytest.approx(sorted(distances), rel=1e-9)


def plate():
    """Return points and nodal areas of an uneven mesh of [0, 2] × [0, 1], fine enough for a disc."""
    mesh = rectangle_mesh(2.0 * np.linspace(0.0, 1.0, 81)**1.2, np.linspace(0.0, 1.0, 51))
    return mesh.points, mass_matrix(mesh).sum(axis=1)


@pytest.mark.parametrize("centre", [(0.6, 0.5), (1.3, 0.3)])
def test_deficit_lies_in_the_middle_of_a_disc(centre):
    """The centroid of a low disc of radius 0.2 in a level of 30 is its centre within a cell, with uneven nodes."""
    points, weights = plate()
    inside = np.hypot(*(points - centre).T) < 0.2
    found = deficit_centroid(30.0 - 10.0 * inside, points, weights)
    assert found.shape == (2,) and np.hypot(*(found - centre)) < 0.01
    unweighted = deficit_centroid(30.0 - 10.0 * inside, points, np.ones(len(points)))
    assert np.hypot(*(found - centre)) < np.hypot(*(unweighted - centre))       # dense nodes must have no larger weight


def test_deficit_counts_only_what_is_lower_than_half():
    """Only the inner half of a cone counts, next to a distant shallower minimum and maximum."""
    points, weights = plate()

    def cone(tip, depth):
        return depth * np.maximum(0.0, 1.0 - np.hypot(*(points - tip).T) / 0.25)

    values = 30.0 - cone((0.5, 0.5), 10.0) + cone((1.5, 0.7), 20.0) - cone((1.5, 0.3), 4.5)
    np.testing.assert_allclose(deficit_centroid(values, points, weights), (0.5, 0.5), atol=0.01)
    flat = np.full(len(points), 3.0)                                   # which has the centroid of the domain
    np.testing.assert_allclose(deficit_centroid(flat, points, weights), (1.0, 0.5), rtol=1e-12)


@pytest.mark.parametrize(("late", "longer", "expected"), [
    (0.0, 0.0, (0.0, 0.0)), (1.3, 0.0, (1.3, 0.0)), (-2.0, 3.0, (2.0, 3.0)), (30.0, 0.0, (8.0, 8.0)),
])
@pytest.mark.parametrize("sign", [1, -1])
def test_slugs_of_a_piecewise_linear_flow(late, longer, expected, sign):
    """Crossings at half height are exact; a slug that no estimate overlaps counts its duration; incomplete slugs do
    not count."""
    t = np.arange(100.0)

    def flow(begin, duration):
        knots = [begin - 4.0, begin + 4.0, begin + duration - 4.0, begin + duration + 4.0]
        return 3.0 + sign * np.interp(t, [*knots, 95.0], [0.0, 1.0, 1.0, 0.0, 0.0])

    found = slug_errors(flow(40.0 + late, 8.0 + longer), flow(40.0, 8.0))
    assert found == pytest.approx(expected, abs=1e-9)
    assert slug_errors(flow(40.0, 8.0), flow(-2.0, 8.0)) is None


@pytest.mark.parametrize("std", [0.0, 0.4, 2.0])
def test_energy_score_of_one_number_is_its_crps(std):
    """The fixed draws cause a deviation of 3 % of the standard deviation."""
    mean, truth = np.linspace(-1.0, 1.0, 50)[:, None], np.zeros((50, 1))
    expected = crps(mean, np.full_like(mean, std), truth, np.ones(1))
    assert energy_score(mean, np.full((50, 1, 1), std**2), truth) == pytest.approx(expected, abs=0.03 * std + 1e-12)


def test_energy_score_is_best_for_the_true_covariance():
    """Independent draws give the same number, and a wrong scale or correlation a larger one; twice as large an unit
    doubles the score."""
    rng = np.random.default_rng(3)
    P = 0.1 * np.eye(4) + np.outer(np.ones(4), np.ones(4))
    truth = rng.multivariate_normal(np.zeros(4), P, 4000)
    mean = np.zeros_like(truth)

    def score(covariance, factor=1.0):
        return energy_score(mean, np.broadcast_to(factor**2 * covariance, (4000, 4, 4)), factor * truth)

    x, other = rng.multivariate_normal(np.zeros(4), P, (2, 4000))
    expected = (np.linalg.norm(x - truth, axis=1).mean() - 0.5 * np.linalg.norm(x - other, axis=1).mean()) / 2
    assert score(P) == pytest.approx(expected, rel=0.03)
    assert all(score(P) < score(wrong) for wrong in (0.4 * P, 2.5 * P, np.diag(P.diagonal())))
    assert score(P, 2.0) == pytest.approx(2.0 * score(P), rel=1e-12)
    assert score(np.outer(np.ones(4), np.ones(4))) == pytest.approx(score(P), rel=0.1)      # of rank one
