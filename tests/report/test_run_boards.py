"""Leaderboards of a user's results and their texts: statistics against scipy, rounding, scores, and order."""

import math

import numpy as np
import pytest
from eitbench.bench.text import format_interval, format_mean, mean_and_interval
from eitbench.data.seeds import seed_ranges
from eitbench.report.boards import environment_title, run_leaderboards, world_key
from eitbench.report.tables import run_table
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from tiny import BOARD_IDS, record, said

FLOOR, REFERENCE = [0.020, 0.024, 0.022], [0.004, 0.002, 0.003]


def made(method, board, errors, kwargs=None, **changes):
    """Return a record whose episode test:i has ``errors[i]``, with optional arguments of its environment."""
    if kwargs:
        changes["environment"] = {"id": BOARD_IDS[board], "name": f"{board}-changed", "kwargs": kwargs}
    return record(method, errors, board=board, version="v1", **changes)


ANCHORS = [made("homogeneous", "smoothing", FLOOR), made("true_model_smoother", "smoothing", REFERENCE)]


def row(records, method, board):
    return next(row.cells for each in run_leaderboards(records) if each.category == board
                for row in each.rows if row.cells["method"] == method)


@given(st.lists(st.floats(0.001, 100.0), min_size=2, max_size=30))
def test_interval_is_students(values):
    """Mean and half width of the 95 % interval equal scipy.stats."""
    mean, half = mean_and_interval(values)
    assert mean == pytest.approx(np.mean(values), rel=1e-12)
    expected = stats.sem(values) * stats.t(len(values) - 1).ppf(0.975)
    assert half == pytest.approx(expected, rel=1e-9, abs=1e-12)
    assert mean_and_interval(values[:1]) == (values[0], math.inf)


@pytest.mark.parametrize(("mean", "half", "text"), [
    (0.00534, 0.00041, "0.0053 ± 0.0004"), (0.00534, 0.00013, "0.00534 ± 0.00013"), (0.0123, math.inf, "0.0123"),
    (0.0096, 0.00096, "0.0096 ± 0.0010"), (0.0, 0.0, "0"), (0.0129, 0.02, "0.013 ± 0.020"), (0.0001, 0.2, "0.0 ± 0.2"),
    (0.0012345, 1.2e-5, "0.00123 ± 0.00001"), (0.5, 4e-6, "0.5"), (1234.0, 50.0, "1234 ± 50"),
])
def test_rounded_examples(mean, half, text):
    """One digit of the interval, two after a 1 or if the mean would have only one; equal decimals."""
    assert format_mean(mean, half) == text


@pytest.mark.parametrize("board", ["filter", "smoothing"])
def test_skill_is_measured_on_shared_episodes(board):
    """Means are over the common episodes of all three: here only the first, (20 − 8)/(20 − 4)."""
    mine = made("mine", board, [0.008, None, None])
    assert row([*ANCHORS, mine], "mine", board)["skill"] == pytest.approx(12 / 16)
    assert row([*ANCHORS, made("mine", board, [None])], "mine", board)["skill"] is None


def test_skill_needs_its_anchors():
    """The normalised score is 0 for the homogeneous estimate in smoothing, 1 for the smoother with the true model.
    Without one of these, or with anchors of another world, it is missing."""
    assert [row(ANCHORS, each["method"], "smoothing")["skill"] for each in ANCHORS] == [0.0, 1.0]
    mine = made("mine", "filter", FLOOR)
    elsewhere = made("mine", "filter", FLOOR, kwargs={"world": {"schedule": {"scored_steps": 16}}})
    theirs = [anchor | {"version": "1" * 8} for anchor in ANCHORS]             # third-party files with these names
    for records in ([mine], [*ANCHORS[:1], mine], [*ANCHORS[1:], mine], [*ANCHORS, elsewhere], [*theirs, mine]):
        assert row(records, "mine", "filter")["skill"] is None
    assert row([*theirs, mine], "mine", "filter")["gain"] is None
    # an assumed velocity does not change the world and its anchors
    wrong = made("mine", "filter", FLOOR, kwargs={"assume": {"mean_velocity": 7.0}})
    assert row([*ANCHORS, wrong], "mine", "filter")["skill"] == pytest.approx(0.0)


@pytest.mark.parametrize("official", [True, False])
def test_anchors_look_back_on_the_longest_made(official):
    """Anchors of the smoothing subtrack have priority, and official ones of several versions."""
    others = [made("homogeneous", "filter", [0.5] * 3), made("true_model_smoother", "filter", [0.4] * 3)]
    mine = made("mine", "filter", REFERENCE)
    assert row([*others, *ANCHORS, mine], "mine", "filter")["skill"] == pytest.approx(1.0)
    assert row([*others, mine], "mine", "filter")["skill"] == pytest.approx((0.5 - 0.003) / 0.1)
    version = made("true_model_smoother", "smoothing", [0.001] * 3) | {"official": official}
    expected = (0.022 - 0.003) / (0.022 - (0.001 if official else 0.003))
    official_anchors = [anchor | {"official": not official} for anchor in ANCHORS]
    for records in ([version, *official_anchors], [*official_anchors, version]):
        assert row([*records, mine], "mine", "filter")["skill"] == pytest.approx(expected)


@pytest.mark.parametrize(("id", "kwargs", "name", "title"), [
    ("eitbench/Pipe3DSmoothing-v0", {"lag": "all", "world": None}, "Pipe3D", "Pipe3DSmoothing-v0 (lag=all)"),
    ("eitbench/Pipe2DBiasedVelocity-v0", {"world": {"region": None}, "assume": {"profile": "plug"}},
     "Pipe2DBiasedVelocity (region=null)", "Pipe2DBiasedVelocity-v0 (assume.profile=plug, region=null)"),
])
def test_names(id, kwargs, name, title):
    """A world's name omits lag and assumptions, which do not change the truth; a title has all arguments."""
    given = {"environment": {"id": id, "name": "x", "kwargs": kwargs}}
    assert (world_key(given), environment_title(given)) == (name, title)


def test_order_of_boards_and_methods():
    """Test seeds are first, then worlds as registered, subtracks, and methods by error; failures are last."""
    records = [made("d", "smoothing", [0.2]), made("e", "filter", {"dev:0": 0.1}), made("c", "filter", [None]),
               made("f", "filter", [0.1], id="eitbench/Pipe3D-v0"), made("b", "filter", [0.3]),
               made("a", "filter", [0.2])]
    found = run_leaderboards(records)
    assert [[row.cells["method"] for row in board.rows] for board in found] == [["a", "b", "c"], ["d"], ["f"], ["e"]]
    assert all(row.cells["rank"] is None for board in found for row in board.rows)


def test_all_episodes_of_a_run_are_shown():
    """A method may have more episodes than the naive baseline; skill scores are of common ones."""
    records = [made("homogeneous", "filter", FLOOR, role="floor"), made("mine", "filter", [0.01] * 5)]
    mine = row(records, "mine", "filter")
    assert mine["seeds"] == "test:0-4" and mine["error"] == pytest.approx(0.01)
    assert mine["gain"] == pytest.approx(1 - 0.01 / 0.022, rel=0.01)


def test_failures_are_counted_not_averaged():
    """Scores are of the finished episodes; the table has the number of failed ones."""
    (board,) = run_leaderboards([made("mine", "filter", [0.1, 0.2, None]), made("bad", "filter", [None])])
    text = said(run_table(board))
    assert list(text["seeds"]) == ["test:0-2, 1 failed", "test:0, 1 failed"] and list(text["ẽ_c"])[1] == "–"
    assert text["ẽ_c"][0] == format_mean(*mean_and_interval([0.1, 0.2]))


def test_units_and_missing_values():
    """Time is in ms, the voltage residual in mV²; the score falls back to 1 − contrast; empty columns are omitted."""
    scores = {"seconds_per_step": 0.0025, "voltage_discrepancy": 4e-6, "contrast_error": 0.25}
    (board,) = run_leaderboards([made("mine", "filter", [0.1], scores=scores), made("other", "filter", [0.2])])
    text = said(run_table(board))
    assert (text["ms/step"][0], text["ẽ_V"][0], text["normalised score"][0]) == ("2.5", "4", "0.75†")
    assert text["ẽ_V"][1] == text["normalised score"][1] == "–" and "CRPS" not in text


def test_the_drawn_table_has_bootstrap_intervals():
    """The rank needs six episodes; the numbers equal the leaderboard."""
    (board,) = run_leaderboards([made("mine", "filter", [0.1, 0.2, 0.15, 0.12, 0.18, 0.11])])
    (cells,) = said(run_table(board, drawn=True)).to_dict("records")
    assert cells["ẽ_c"] == format_interval(*board.rows[0].interval("error")) and "(" in cells["ẽ_c"]


def test_seeds_are_named_by_their_ranges():
    assert seed_ranges(["test:0", "test:1", "test:2", "test:7"]) == "test:0-2,7"
    assert seed_ranges(["dev:10", "dev:9"]) == "dev:9-10" and seed_ranges(["300001"]) == "300001"
