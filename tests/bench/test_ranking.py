"""Ranks of many methods at once are those of the definition, pair by pair."""

from itertools import combinations

import numpy as np
import pytest
from eitbench.bench import ranking
from eitbench.bench.ranking import shared_ranks
from eitbench.bench.statistics import interquartile_mean, mean_over_environments, paired_difference, tail

DRAWS = 500


def plain_ranks(scores, unranked=(), *, statistic=mean_over_environments, higher=False):
    """By the definition: one more than how many are significantly better."""
    sign = -1.0 if higher else 1.0
    values = {name: sign * statistic(*(np.sort(list(own[env].values())) for env in sorted(own)))
              for name, own in scores.items()}
    order = sorted(scores, key=lambda name: (values[name], name))
    ranks = {name: 1 for name in order if name not in unranked}
    for first, second in combinations(ranks, 2):
        _, low, high = paired_difference(scores[first], scores[second], statistic=statistic, draws=DRAWS)
        low, high = sorted((sign * low, sign * high))
        ranks[second] += high < 0
        ranks[first] += low > 0
    return {name: ranks.get(name) for name in order}


def a_board(seed):
    """Of some methods: close to each other or not, with ties, twins, and seeds that only some have."""
    random = np.random.default_rng(seed)
    sizes = random.integers(2, 14, size=random.integers(1, 4))
    methods, scores = int(random.integers(2, 12)), {}
    spread, digits = random.choice([0.0, 0.05, 1.0]), int(random.choice([1, 2, 15]))
    for i in range(methods):
        level, own = random.normal(1.0, spread), {}
        for e, n in enumerate(sizes):
            hard = np.random.default_rng([seed, e]).lognormal(size=n)
            drawn = np.round(level * hard * random.lognormal(0.0, random.choice([0.01, 0.5]), size=n), digits)
            keys = [f"test:{k}" for k in range(n)]
            own[f"e{e}"] = dict(zip(keys, drawn.tolist(), strict=True))
            if seed % 3 == 0 and n > 3 and random.random() < 0.3:
                own[f"e{e}"].pop(keys[random.integers(n)])
            own[f"e{e}"] = {key: own[f"e{e}"][key] for key in random.permutation(list(own[f"e{e}"]))}
        scores[f"m{i}"] = own
    twin = {env: dict(own) for env, own in scores["m0"].items()}
    return scores | {"twin": twin}


@pytest.mark.parametrize("higher", [False, True])
@pytest.mark.parametrize("statistic", [mean_over_environments, interquartile_mean])
def test_as_by_the_definition(statistic, higher):
    """On boards of every kind, whoever is left out of the ranking."""
    for seed in range(40):
        scores = a_board(seed)
        unranked = {"m1"} if seed % 2 else set()
        found = shared_ranks(scores, unranked, statistic=statistic, higher_is_better=higher, draws=DRAWS)
        assert list(found.items()) == list(plain_ranks(
            scores, unranked, statistic=statistic, higher=higher).items()), seed


def test_differences_that_rounding_decides():
    """Methods that differ by the last digit, or cancel, are compared as all others are."""
    random = np.random.default_rng(1)
    base = random.lognormal(size=10)
    rows = {"a": base, "b": base * (1 + 1e-16), "c": np.nextafter(base, 2), "d": base + 1e-13 * random.normal(size=10),
            "e": base + np.array([1e-9, -1e-9] * 5), "f": base + np.eye(10)[3], "g": base - 1e-7}
    scores = {name: {"pipe": {f"test:{i}": value for i, value in enumerate(row.tolist())}}
              for name, row in rows.items()}
    assert shared_ranks(scores, draws=DRAWS) == plain_ranks(scores)


def test_of_many_a_resample_is_the_same_for_all(monkeypatch):
    """Of many methods the interquartile mean is resampled once for each: ranks are by the differences of these."""
    monkeypatch.setattr(ranking, "MANY", 2)
    scores = {name: {env: {seed: own[env][seed] for seed in sorted(own[env])} for env in own}
              for name, own in a_board(1).items()}
    found = shared_ranks(scores, statistic=interquartile_mean, draws=DRAWS)
    names = list(next(iter(scores.values())))
    sizes = [len(scores["m0"][name]) for name in names]
    random = np.random.default_rng(0)
    drawn = [random.integers(n, size=(DRAWS, n)) for n in sizes]
    values = {method: interquartile_mean(*(np.array(list(own[name].values()))[positions]
                                           for name, positions in zip(names, drawn, strict=True)))
              for method, own in scores.items()}
    for method in scores:
        highs = [np.percentile(values[other] - values[method], 100 - tail(tuple(sizes))) for other in scores]
        assert found[method] == 1 + sum(high < 0 for high in highs)
