"""Comparison of two methods: numbers equal the statistics on their common episodes."""

import math

import numpy as np
import pytest
from eitbench.bench.records import write_record
from eitbench.bench.statistics import interquartile_mean, paired_difference, paired_probability_of_improvement
from eitbench.bench.text import scores_by_seed
from eitbench.report import compare as comparison
from eitbench.report.compare import (
    compare,
    comparison_table,
    find_records,
    format_comparison,
    naive_baseline_records,
)

from tiny import boards, record, said, sha

TANK = "eitbench/RotatingTank2D-v0"
PIPE = "eitbench/Pipe2D-v0"


def two_methods():
    """Return records in which a is better in the tank and not significantly in the pipe."""
    random = np.random.default_rng(3)
    hard = random.lognormal(-2.0, 0.5, (2, 12))
    a, b = hard * random.uniform(0.8, 1.1, (2, 12)), hard * random.uniform(0.9, 1.2, (2, 12))
    b[1] += 0.1
    return [[record(name, errors.tolist(), **({"id": TANK} if i else {})) for i, errors in enumerate(both)]
            for name, both in (("a", a), ("b", b))]


def errors_of(records):
    return {each["environment"]["id"]: scores_by_seed(each, "error") for each in records}


def test_numbers_are_those_of_the_statistics():
    """Each environment has differences, fractions and their intervals."""
    a, b = two_methods()
    table = compare(a, b).set_index("environment")
    assert list(table.index) == [PIPE, TANK] and list(table["episodes"]) == [12, 12]
    x, y = errors_of(a), errors_of(b)
    for name in (PIPE, TANK):
        own, other = ({name: scores[name]} for scores in (x, y))
        assert tuple(table.loc[name, ["advantage", "low", "high"]]) == paired_difference(other, own)
        assert tuple(table.loc[name, ["better", "better_low", "better_high"]]) == (
            paired_probability_of_improvement(own, other))
        assert table["a"][name] == pytest.approx(np.mean(list(x[name].values())))
        assert table["b"][name] - table["a"][name] == pytest.approx(table["advantage"][name])
    assert table["low"][TANK] > 0 < table["better_low"][TANK]
    swapped = compare(b, a).set_index("environment")
    np.testing.assert_allclose(swapped["advantage"], -table["advantage"])
    np.testing.assert_allclose(swapped["better"], 1 - table["better"])


def test_an_agent_is_the_mean_of_its_trainings(tmp_path):
    """Without a training seed the name of an agent means the average, in episodes that every training finished."""
    errors = np.random.default_rng(0).uniform(0.1, 0.2, (3, 8))
    for name, row in zip(("ppo_seed0", "ppo_seed1", "other"), errors, strict=True):
        write_record(tmp_path, record(name, row[:7 if name == "ppo_seed1" else 8].tolist(), id=TANK))
    table = compare(find_records("ppo", tmp_path), find_records("other", tmp_path))
    assert table["a"].item() == pytest.approx(errors[:2, :7].mean()) and table["episodes"].item() == 7
    (mean,) = find_records("ppo", tmp_path)
    assert (mean["method"], mean["version"]) == ("ppo", "mean over trainings")
    assert compare([mean], [mean], "seconds_per_step")["a"].item() == pytest.approx(10.0)             # ms


def test_over_environments_gains_are_compared():
    """a halves the error of the pipe and is slightly worse in the tank, with errors a hundred times larger: by
    skill scores it is better, as on the leaderboards. Without naive baselines the aggregate is empty."""
    floor = [record("homogeneous", [scale] * 12, official=True, **where)
             for scale, where in ((0.02, {}), (2.0, {"id": TANK}))]
    noise = 1.0 + 0.01 * np.random.default_rng(1).normal(size=12)
    a, b = ([record(name, (scale * 0.02 * noise).tolist(), official=True),
             record(name, (other * 2.0 * noise).tolist(), id=TANK, official=True)]
            for name, scale, other in (("a", 0.25, 0.52), ("b", 0.5, 0.5)))
    table = compare(a, b, zero=floor)
    assert list(table["environment"]) == [PIPE, TANK, "all filter (2 environments)"]
    assert list(table["score"]) == ["error", "error", "skill score"] and table["episodes"][2] == 24
    one, other = ({name: {seed: 1 - error / scale for seed, error in errors.items()}
                   for (name, errors), scale in zip(errors_of(side).items(), (0.02, 2.0), strict=True)}
                  for side in (a, b))
    assert tuple(table.loc[2, ["advantage", "low", "high"]]) == pytest.approx(
        paired_difference(one, other, statistic=interquartile_mean), rel=1e-12)
    assert table["low"][2] > 0 and table["better"][2] == 0.5
    gains = boards([*floor, *a, *b]).query("environment == 'all'").set_index("method")["gain"]
    assert (table["a"][2], table["b"][2]) == pytest.approx((gains["a"], gains["b"]), rel=1e-12)
    text = said(comparison_table(table))
    assert list(text["better"]) == ["A", "B", "A"] and text["ẽ_c of A"][2].startswith("skill score 0.")
    assert list(compare(a, b)["environment"]) == [PIPE, TANK]
    assert list(compare(a, b, "seconds_per_step", floor)["environment"]) == [PIPE, TANK, "all"]


def test_only_shared_episodes_count():
    """Two methods with three seeds each have one common seed without a failure."""
    a = [record("a", {"test:0": 0.1, "test:1": None, "test:2": 0.3})]
    b = [record("b", {"test:0": 0.4, "test:1": 0.1, "test:3": 0.3}), record("b", [0.1], id=TANK)]
    (row,) = compare(a, b).to_dict("records")
    assert (row["episodes"], row["a"], row["b"], row["better"]) == (1, 0.1, 0.4, 1.0)
    dev = [record(name, {"dev:0": error}) for name, error in (("a", 0.2), ("b", 0.1))]
    table = compare([*a, dev[0]], [dev[1], *b])
    assert list(table["environment"]) == [f"{PIPE} (dev seeds)", PIPE]
    assert row["advantage"] == pytest.approx(0.3) and (row["low"], row["high"]) == (-math.inf, math.inf)
    (text,) = said(comparison_table(compare(a, b))).to_dict("records")
    assert (text["better"], text["A better"], text["advantage of A"]) == ("–", "100 %", "0.3")


def test_what_cannot_be_compared():
    a = [record("a", [0.1])]
    for b in ([record("b", [0.1], id=TANK)], [record("b", {"test:9": 0.1})], [record("b", {"dev:0": 0.1})],
              [record("b", [None])]):
        with pytest.raises(ValueError, match="methods must share an environment and a seed"):
            compare(a, b)


def test_records_are_found_by_name_version_and_file(tmp_path, monkeypatch):
    """A name is sufficient if it has one version."""
    monkeypatch.setattr(comparison, "BUNDLED_RECORDS", tmp_path)
    a, (b, _) = two_methods()
    paths = [write_record(tmp_path, each) for each in [*a, b, record("homogeneous", [0.1])]]
    assert find_records("a", tmp_path) == a and find_records(f"a@{sha('a1')[:8]}", tmp_path) == a
    assert find_records(str(paths[2]), tmp_path / "nowhere") == [b]
    write_record(tmp_path, newer := record("a", [0.1], version="2"))
    with pytest.raises(ValueError, match=rf"a fits several versions: a@{sha('a2')[:8]}, a@{sha('a1')[:8]}"):
        find_records("a", tmp_path)
    assert find_records(f"a@{sha('a2')[:8]}", tmp_path) == [newer]
    for other, names in ((a[0], f"A: a@{sha('a2')[:8]}\nB: a@{sha('a1')[:8]}\n"), (b, "A: a\nB: b\n")):
        assert format_comparison(compare([newer], [other]), newer, other, "error", 100).startswith(names)
    ours = [record("c", [0.1], version=version) for version in ("v1", "v2", "v10")]
    for i, each in enumerate(ours):
        write_record(tmp_path, each)
        assert find_records("c@v1", tmp_path) == ours[:1] and find_records("c", tmp_path) == [ours[i]]
    for nobody, message in (("d", ""), ("c@v", ""), ("homogeneus", r".* Did you mean homogeneous\?")):
        with pytest.raises(ValueError, match=f"record of {nobody} {message}"):
            find_records(nobody, tmp_path)


def test_methods_that_are_not_in_the_folder_are_found_in_the_package(tmp_path, monkeypatch):
    """After a first submission in a user's folder, the method is compared with built-in ones and naive baselines."""
    shipped, own = tmp_path / "shipped", tmp_path / "own"
    monkeypatch.setattr(comparison, "BUNDLED_RECORDS", shipped)
    ours, floor = record("kalman_filter", [0.1], version="v1"), record("homogeneous", [0.2], role="floor")
    for folder, each in ((own, mine := record("mine", [0.1])), (shipped, ours), (shipped, floor)):
        write_record(folder, each)
    assert find_records("mine", own) == [mine] and find_records("kalman_filter", own) == [ours]
    assert naive_baseline_records(own) == naive_baseline_records(tmp_path / "nowhere") == [floor]
