"""Is a record too good? Honest ones rarely, the attacks that were tried always."""

import numpy as np
import pytest
from eitbench._files import shipped
from eitbench.bench.records import read_record
from eitbench.bench.text import scores_by_seed
from eitbench.bench.too_good import LEVEL, Finding, judged, too_good

NAMES = ["ẽ_c over the floor's", "gain over the floor", "smallest ratio"]


def published(method, world="Pipe2D", floor="homogeneous"):
    """(n, 2) ẽ_c of a method and the floor, as on the board."""
    own, zero = (scores_by_seed(read_record(
        shipped("leaderboards") / "results" / f"eitbench-{world}-v0--{name}--v1.json"), "error")
        for name in (method, floor))
    return np.array([[own[seed], zero[seed]] for seed in own])


def drawn(random, n, ratio=0.25, spread=0.17):
    """Pairs as a Kalman filter has them."""
    floor = 0.02 * random.lognormal(0.0, 0.3, n)
    return np.stack([ratio * floor * random.lognormal(0.0, spread, n), floor], axis=1)


def names(findings):
    return {finding.name for finding in findings}


@pytest.mark.parametrize("count", [10, 30, 100])
def test_who_knows_two_hard_episodes_is_found(count):
    """A Kalman filter that is told the truth of the two hardest test episodes of Pipe2D: 0.00503 becomes 0.00352."""
    honest = published("kalman_filter")
    cheat = honest.copy()
    cheat[np.argsort(honest[:, 0])[-2:], 0] = 1.2e-5
    assert honest[:, 0].mean() == pytest.approx(0.00503, abs=5e-6)
    assert cheat[:, 0].mean() == pytest.approx(0.00352, abs=5e-6)
    random = np.random.default_rng(1)
    for _ in range(20):
        held_out = drawn(random, count)
        assert "smallest ratio" in names(too_good(judged(cheat, held_out, 500)))


def test_who_is_better_everywhere_is_found():
    """A record of a third less error in every episode, though none of them stands out."""
    random = np.random.default_rng(2)
    found = [names(too_good(judged(drawn(random, 10, 0.17), drawn(random, 30), 500))) for _ in range(20)]
    assert all({*NAMES[:2]} & each for each in found)


def test_by_hand():
    """Means over means, interquartile means of gains, the least ratio; of two pairs each there are six orders."""
    record, new = np.array([[1.0, 10.0], [3.0, 10.0]]), np.array([[4.0, 10.0], [6.0, 20.0]])
    a, b, c = judged(record, new, 20_000)
    assert [a.name, b.name, c.name] == NAMES
    assert (a.record, a.held_out) == pytest.approx((0.2, 1 / 3))
    assert (b.record, b.held_out) == pytest.approx((0.8, 0.65))
    assert (c.record, c.held_out) == pytest.approx((0.1, 0.3))
    # Were 1 and 4 the record, its gains would be as good, 0.8 and 0.65; its means less so, 7/30 and 7/20.
    assert a.p == pytest.approx(1 / 6, abs=0.01) and b.p == pytest.approx(2 / 6, abs=0.01)


def test_to_be_worse_is_no_fault():
    """Nobody gains by a record that is worse than the method."""
    random = np.random.default_rng(3)
    assert not too_good(judged(drawn(random, 10, 0.5), drawn(random, 30), 500))


def test_the_floor_itself():
    """Its ratios are all one, but for the rounding of another machine; a forged one is found."""
    random = np.random.default_rng(4)
    floor = 0.02 * random.lognormal(0.0, 0.3, 20)
    same = np.stack([floor, floor], axis=1)
    other = same[:10] * [1.0 - 1e-10, 1.0]
    assert not too_good(judged(other, same[10:], 500))
    assert too_good(judged(same[:10] * [1.0 - 1e-4, 1.0], same[10:], 500))


def test_an_error_of_zero_is_very_good():
    """Not an error of ours."""
    random = np.random.default_rng(5)
    perfect = drawn(random, 10) * [0.0, 1.0]
    assert names(too_good(judged(perfect, drawn(random, 10), 500))) == set(NAMES)


def test_holm():
    """The least against a third of the level, the next against the half; who fails stops the rest."""
    def of(*p):
        return [f.p for f in too_good([Finding("", 0.0, 0.0, each) for each in p])]

    third = LEVEL / 3
    assert of(0.9, third, 0.02) == [third, 0.02] and of(0.02, 0.02, 0.02) == [] and of(0.001, 0.04, 0.03) == [0.001]
    assert of(0.001, 0.04, 0.02) == [0.001, 0.02, 0.04]


@pytest.mark.parametrize(("record", "message"), [
    ([[1.0, 1.0]], "at least two pairs"), ([1.0, 2.0], "at least two pairs"),
    ([[1.0, 1.0], [np.nan, 1.0]], "must hold errors"), ([[1.0, 1.0], [1.0, 0.0]], "must hold errors")])
def test_what_is_no_pairs_is_refused(record, message):
    """In words."""
    with pytest.raises(ValueError, match=message):
        judged(np.array(record), np.ones((3, 2)))


def test_honest_ones_pass():
    """Of 400 drawn from one population at most one in twenty is called too good, but for chance."""
    random = np.random.default_rng(6)
    wrong = sum(bool(too_good(judged(drawn(random, 10), drawn(random, 20), 500))) for _ in range(400))
    assert wrong <= 0.05 * 400 + 2 * np.sqrt(0.05 * 0.95 * 400)
