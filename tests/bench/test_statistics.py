"""Statistics of a leaderboard: comparison with hand-computed numbers and brute force, and coverage of intervals."""

import math

import numpy as np
import pytest
from eitbench.bench.statistics import (
    interquartile_mean,
    mean_over_environments,
    paired_difference,
    paired_probability_of_improvement,
    shared_ranks,
    stratified_bootstrap,
)
from scipy import stats


def seeded(values, split="test"):
    """Return environment -> seed -> score for one environment of one method."""
    return {f"{split}:{i}": float(value) for i, value in enumerate(values)}


def shuffled(scores, random):
    """Return the same scores with environments and seeds in another order."""
    return {environment: {str(seed): own[seed] for seed in random.permutation(list(own))}
            for environment, own in reversed(scores.items())}


def two_methods(seed=5):
    """Return scores of two methods on shared hard and easy episodes of three environments, some of them equal."""
    random = np.random.default_rng(seed)
    a, b = {}, {}
    for environment, n in (("pipe", 12), ("tank", 20), ("obstacle", 9)):
        hardness = random.lognormal(0.0, 1.0, n)
        a[environment] = seeded(np.round(hardness + random.normal(0.0, 0.3, n), 1))
        b[environment] = seeded(np.round(hardness + random.normal(0.1, 0.3, n), 1))
    return a, b


def plain(scores):
    return {environment: list(own.values()) for environment, own in scores.items()}


@pytest.mark.parametrize("n", range(1, 30))
def test_interquartile_mean_is_scipys(n):
    """It is the 25 % trimmed mean of the pooled environments, also for several resamples at once."""
    scores = np.random.default_rng(n).normal(size=(4, n))
    assert interquartile_mean(scores) == pytest.approx(stats.trim_mean(scores, 0.25, axis=1), rel=1e-12)
    assert interquartile_mean(*scores) == pytest.approx(stats.trim_mean(scores, 0.25, axis=None), rel=1e-12)


@pytest.mark.parametrize(("n", "statistic", "expected"), [
    (6, mean_over_environments, 0.932), (10, interquartile_mean, 0.972)])
def test_coverage(n, statistic, expected):
    """The coverage of 1000 intervals for n normal numbers agrees with 6000 other data sets to 3 standard errors.
    Without the expansion by Student's t it is too small, 0.854 and 0.937."""
    random, held = np.random.default_rng(11), 0
    for _ in range(1000):
        _, low, high = stratified_bootstrap({"pipe": random.normal(3.0, 2.0, n)}, statistic, n_resamples=1000)
        held += low <= 3.0 <= high
    assert held / 1000 == pytest.approx(expected, abs=3 * math.sqrt(expected * (1 - expected) / 1000))


def test_coverage_over_environments():
    """For strata of different size, mean and variance, 95 % ± 3.3 % of 400 intervals contain the mean of their means.

    Pooled resampling would treat the differences between environments as noise, and the coverage would be 100 %.
    """
    random, held, width = np.random.default_rng(12), 0, []
    for _ in range(400):
        scores = {"a": random.normal(0.0, 1.0, 30), "b": random.normal(50.0, 2.0, 40), "c": random.normal(9.0, 1.0, 25)}
        _, low, high = stratified_bootstrap(scores, mean_over_environments, n_resamples=1000)
        held += low <= 59 / 3 <= high
        width.append(high - low)
    assert held / 400 == pytest.approx(0.95, abs=0.033)
    expected = 2 * stats.t(92).ppf(0.975) / 3 * math.sqrt(1 / 30 + 4 / 40 + 1 / 25)
    assert np.mean(width) == pytest.approx(expected, rel=0.03)


def test_too_few_episodes_have_no_interval():
    """Five episodes, or a single one in an environment, have no interval; six have one."""
    a, b = np.arange(5.0), np.arange(10.0)
    assert stratified_bootstrap({"pipe": a}, mean_over_environments) == (2.0, -math.inf, math.inf)
    assert stratified_bootstrap({"pipe": [1.0], "tank": b}, mean_over_environments)[1:] == (-math.inf, math.inf)
    value, low, high = stratified_bootstrap({"pipe": a[:2], "tank": b[:4]}, mean_over_environments)
    assert value == 1.0 and 0.0 <= low < 1.0 < high <= 2.0
    assert paired_probability_of_improvement({"pipe": seeded(a)}, {"pipe": seeded(a + 1)}) == (1.0, 0.0, 1.0)


def test_paired_difference_of_interquartile_means():
    """It agrees, within Monte-Carlo error, with scipy's trimmed mean of the same resampled episodes
    of both methods, at Student's percentiles for 41 episodes in three environments."""
    a, b = two_methods()
    random = np.random.default_rng(6)
    drawn = [random.integers(len(own), size=(4000, len(own))) for own in a.values()]
    x, y = (stats.trim_mean(np.concatenate([np.array(own)[each] for own, each in zip(
        plain(scores).values(), drawn, strict=True)], axis=1), 0.25, axis=1) for scores in (a, b))
    value, low, high = paired_difference(a, b, statistic=interquartile_mean)
    assert value == interquartile_mean(*plain(a).values()) - interquartile_mean(*plain(b).values())
    cut = 100 * stats.norm.sf(stats.t(38).ppf(0.975) * math.sqrt(41 / 38))
    theirs = tuple(np.percentile(x - y, [cut, 100 - cut]))
    assert (low, high) == pytest.approx(theirs, abs=4 * 0.05 * np.std(x - y))
    same = paired_difference(a, b, statistic=mean_over_environments)
    assert same == paired_difference(a, b) and same[0] != value


@pytest.mark.parametrize("statistic", [mean_over_environments, interquartile_mean])
def test_exchanged_methods_have_the_negative_difference(statistic):
    """The sign changes to the last bit, in any order of environments and seeds."""
    a, b = two_methods()
    value, low, high = paired_difference(a, b, statistic=statistic)
    random = np.random.default_rng(0)
    one, other = shuffled(a, random), shuffled(b, random)
    assert list(one["pipe"]) != list(a["pipe"])
    assert paired_difference(other, one, statistic=statistic) == (-value, -high, -low)
    assert paired_probability_of_improvement(one, other) == paired_probability_of_improvement(a, b)
    assert stratified_bootstrap(plain(one), statistic) == stratified_bootstrap(plain(a), statistic)


def test_paired_numbers_by_hand():
    """Scores on other seeds change nothing; environments have equal weights. Better in 3 of 8 and equal in 2 has the
    probability (3 + 1)/8, and 1 in the other environment; higher may be better."""
    a = {"pipe": seeded(np.arange(8.0)), "tank": seeded(np.arange(6.0))}
    b = {"pipe": seeded([3.0] * 8)}
    b["tank"] = {seed: score - 2.0 for seed, score in a["tank"].items()}
    expected = paired_difference(a, b)
    assert expected[0] == pytest.approx((0.5 + 2.0) / 2)
    more = {"pipe": a["pipe"] | {"test:99": 1e6}, "tank": {"dev:1": 1e6} | a["tank"]}
    assert paired_difference(more, b) == expected
    assert paired_difference(a, {"pipe": b["pipe"] | {"test:98": -1e6}, "tank": b["tank"]}) == expected
    one = {"pipe": seeded([0, 0, 0, 1, 1, 2, 2, 2]), "tank": seeded([0] * 4)}
    other = {"pipe": seeded([1] * 8), "tank": seeded([1] * 4)}
    assert paired_probability_of_improvement(one, other)[0] == 0.75
    assert paired_probability_of_improvement(one, other, higher_is_better=True)[0] == 0.25
    assert paired_probability_of_improvement(one, one) == (0.5, 0.5, 0.5)


NOISE = np.tile([-1.0, 1.0], 6)


def board(**methods):
    """Return method -> its scores in a single environment."""
    return {method: {"pipe": seeded(scores)} for method, scores in methods.items()}


@pytest.mark.parametrize(("scores", "how", "expected"), [
    # each worse than the one before on every episode, best first; higher may be better
    (board(c=NOISE + 3, a=NOISE + 1, b=NOISE + 2), {}, {"a": 1, "b": 2, "c": 3}),
    (board(c=NOISE + 3, a=NOISE + 1, b=NOISE + 2), {"higher_is_better": True}, {"c": 1, "b": 2, "a": 3}),
    (board(a=NOISE), {}, {"a": 1}), ({}, {}, {}),
    # a difference by rounding in every episode
    (board(a=np.ones(12), b=np.full(12, 1.0 + 1e-12)), {}, {"a": 1, "b": 1}),
    # not transitive: no significant difference of a and b, nor of b and c, but a is better than c
    (board(a=0 * NOISE, b=0.5 + 1.5 * NOISE, c=np.ones(12)), {}, {"a": 1, "b": 1, "c": 2}),
    # a single outlier affects the mean, and not the interquartile mean
    (board(a=np.zeros(24), b=np.r_[np.full(23, -1.0), 100.0]), {}, {"a": 1, "b": 1}),
    (board(a=np.zeros(24), b=np.r_[np.full(23, -1.0), 100.0]), {"statistic": interquartile_mean}, {"b": 1, "a": 2}),
    # four better episodes are not significant: for equal methods the probability is 1/8
    (board(a=NOISE[:4], b=NOISE[:4] + 1), {}, {"a": 1, "b": 1})])
def test_shared_ranks(scores, how, expected):
    assert list(shared_ranks(scores, **how).items()) == list(expected.items())


def a_board(seed):
    """Return random scores of methods with large or small differences, with ties and duplicates."""
    random = np.random.default_rng(seed)
    sizes = random.integers(2, 14, size=random.integers(1, 4))
    spread, digits = random.choice([0.0, 0.05, 1.0]), int(random.choice([1, 2, 15]))
    scores = {}
    for i in range(int(random.integers(2, 8))):
        level = random.normal(1.0, spread)
        scores[f"m{i}"] = {f"e{e}": seeded(np.round(level * random.lognormal(0.0, 0.3, size=n), digits))
                           for e, n in enumerate(sizes)}
    return scores | {"twin": {name: dict(own) for name, own in scores["m0"].items()}}


@pytest.mark.parametrize("higher", [False, True])
@pytest.mark.parametrize("statistic", [mean_over_environments, interquartile_mean])
def test_ranks_agree_with_the_definition(statistic, higher):
    """Ranks count significant paired differences, for random leaderboards in any order."""
    for seed in range(6):
        scores = a_board(seed)
        listed = {name: shuffled(scores[name], np.random.default_rng(seed)) for name in reversed(scores)}
        found = shared_ranks(listed, statistic=statistic, higher_is_better=higher, n_resamples=500)
        for name in scores:
            others = [paired_difference(scores[name], scores[other], statistic=statistic, n_resamples=500)
                      for other in scores]
            better = sum(high < 0 if higher else low > 0 for _, low, high in others)
            assert found[name] == 1 + better, seed
        values = [statistic(*(list(own.values()) for own in scores[name].values())) for name in found]
        assert values == pytest.approx(sorted(values, reverse=higher), rel=1e-12)


@pytest.mark.parametrize(("call", "message"), [
    (lambda: interquartile_mean(), "scores must hold"),
    (lambda: stratified_bootstrap({"pipe": NOISE}, np.mean), "statistic must reduce the last axis only"),
    (lambda: stratified_bootstrap({"pipe": NOISE}, interquartile_mean, n_resamples=0), "n_resamples must be"),
    (lambda: stratified_bootstrap({"pipe": [1.0, math.nan]}, interquartile_mean), "scores must be finite"),
    (lambda: paired_difference({"pipe": seeded(NOISE)}, {"pipe": seeded(NOISE, "dev")}), "compared methods share"),
    (lambda: paired_difference({"pipe": seeded(NOISE)}, {"tank": seeded(NOISE)}), "environments must .* pipe and tank"),
    (lambda: shared_ranks(board(a=NOISE) | {"b": {"tank": seeded(NOISE)}}), "environments must be the same"),
    (lambda: shared_ranks(board(a=NOISE, b=NOISE[:7])), "must be of the same episodes, got others of a"),
])
def test_errors_name_the_argument(call, message):
    with pytest.raises(ValueError, match=message):
        call()
