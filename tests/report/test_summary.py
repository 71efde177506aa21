"""From records to a table: statistics against scipy, rounding that loses no meaning, skill, and order."""

import math
import re

import numpy as np
import pytest
from eitbench.bench.scores import scores as registered
from eitbench.bench.text import mean_and_interval, number, rounded, scores_by_seed, seed_ranges
from eitbench.report.summary import explanations, shown, summary
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from tables import said

BOARD_IDS = {"filter": "eitbench/Pipe2D-v0", "fixed-lag": "eitbench/Pipe2DFixedLag-v0",
             "smoothing": "eitbench/Pipe2DSmoothing-v0"}


def record(baseline, board, errors, *, failed=(), kwargs=None, id=None, **scores):
    """A record whose episode test:i has ``errors[i]``."""
    def one(i, error):
        if i in failed:
            return {"seed": f"test:{i}", "status": "failed", "message": "oh", "finished": ""}
        return {"seed": f"test:{i}", "status": "ok", "finished": "",
                "scores": dict.fromkeys(registered()) | {"error": error} | scores}

    return {"method": baseline, "title": baseline.replace("_", " "), "board": board, "split": "test",
            "official": False, "seeds": [f"test:{i}" for i in range(len(errors))],
            "environment": {"id": id or BOARD_IDS[board], "name": f"{board}-v0",
                            "kwargs": kwargs or {}},
            "episodes": [one(i, error) for i, error in enumerate(errors)]}


FLOOR, REFERENCE = [0.020, 0.024, 0.022], [0.004, 0.002, 0.003]
ANCHORS = [record("homogeneous", "smoothing", FLOOR), record("true_model_smoother", "smoothing", REFERENCE)]


def row(records, baseline, board):
    """The table's row of one baseline."""
    table = summary(records)
    return table[(table["baseline"] == baseline) & (table["board"] == board)].iloc[0]


# -- statistics -------------------------------------------------------------------------------------------------------


@given(st.lists(st.floats(0.001, 100.0), min_size=2, max_size=30))
def test_interval_is_students(values):
    """Mean and half width of the 95 % interval, as scipy.stats has them."""
    mean, half = mean_and_interval(values)
    assert mean == pytest.approx(np.mean(values), rel=1e-12)
    expected = stats.sem(values) * stats.t(len(values) - 1).ppf(0.975)
    assert half == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_interval_of_known_numbers():
    """1, 2, 3: t = 4.303 at two degrees of freedom, over √3. One value has no interval."""
    assert mean_and_interval([1.0, 2.0, 3.0]) == pytest.approx((2.0, 4.302653 / math.sqrt(3)), rel=1e-6)
    assert mean_and_interval([0.5]) == (0.5, math.inf)


@pytest.mark.parametrize(("mean", "half", "text"), [
    (0.00534, 0.00041, "0.0053 ± 0.0004"), (0.00534, 0.00013, "0.00534 ± 0.00013"), (1.234, 0.5, "1.2 ± 0.5"),
    (12.34, 3.0, "12 ± 3"), (123.4, 1.2, "123.4 ± 1.2"), (0.0096, 0.00096, "0.0096 ± 0.0010"),
    (0.0123, math.inf, "0.0123"), (2.0, 0.0, "2"), (0.0, 0.0, "0"),
])
def test_rounded_examples(mean, half, text):
    """The interval has one significant digit, two after a 1; the mean ends at the same place."""
    assert rounded(mean, half) == text


@given(st.floats(1e-3, 100.0), st.floats(1.01e-5, 1.0))
def test_rounding_stays_within_the_interval(mean, part):
    """Read back, the mean lies within the interval, which is right to a third; both end at the same decimal place."""
    half = max(part * mean, 1.01e-5)
    shown = rounded(mean, half)
    match = re.fullmatch(r"(\d+(?:\.(\d+))?) ± (\d+(?:\.(\d+))?)", shown)
    assert match, shown
    assert abs(float(match[1]) - mean) <= half / 2
    assert abs(float(match[3]) - half) <= 0.34 * half
    assert len(match[2] or "") == len(match[4] or "")


@given(st.floats(1e-4, 1.0), st.floats(0.0, 1e-5))
def test_no_interval_is_shown_as_nothing(mean, half):
    """An interval too narrow for the table is left out, or keeps a digit; "± 0.00000" would claim certainty."""
    shown = rounded(mean, half)
    assert float(shown.split(" ± ")[0]) == pytest.approx(mean, rel=6e-3)
    assert "±" not in shown or float(shown.split(" ± ")[1]) > 0


@pytest.mark.parametrize(("value", "text"), [(0.01234, "0.012"), (1.234, "1.23"), (29.47, "29.5"), (999.4, "999"),
                                           (999.6, "1000"), (3078.2, "3078"), (0.0, "0"), (-1.234, "-1.23")])
def test_numbers_are_short_and_never_powers_of_ten(value, text):
    assert number(value) == text


# -- skill ------------------------------------------------------------------------------------------------------------


def test_skill_of_the_anchors():
    """0 for the homogeneous estimate of the smoothing board, 1 for the smoother with the true model."""
    assert row(ANCHORS, "homogeneous", "smoothing")["skill"][0] == 0.0
    assert row(ANCHORS, "true_model_smoother", "smoothing")["skill"][0] == 1.0


@pytest.mark.parametrize("board", BOARD_IDS)
def test_skill_is_measured_on_shared_episodes(board):
    """On each board, means over the episodes that all three have: here only the first, (20 − 8)/(20 − 4)."""
    mine = record("mine", board, [0.008, 0.1, 0.1], failed=(1, 2))
    assert row([*ANCHORS, mine], "mine", board)["skill"][0] == pytest.approx(12 / 16)
    assert row([*ANCHORS, record("mine", board, [0.1], failed=(0,))], "mine", board)["skill"] is None


def test_skill_needs_its_anchors():
    """Without either anchor, or with anchors of another world only, there is no skill."""
    mine = record("mine", "filter", FLOOR)
    for others in ([], ANCHORS[:1], ANCHORS[1:]):
        assert row([*others, mine], "mine", "filter")["skill"] is None
    elsewhere = record("mine", "filter", FLOOR, kwargs={"world": {"schedule": {"scored_steps": 16}}})
    assert row([*ANCHORS, elsewhere], "mine", "filter")["skill"] is None


def test_skill_of_a_wrong_belief():
    """1 is the smoother that knows the true model, so an assumed velocity has the same anchors as none."""
    wrong = record("mine", "filter", FLOOR, kwargs={"assume": {"mean_velocity": 7.0}})
    assert row([*ANCHORS, wrong], "mine", "filter")["skill"][0] == pytest.approx(0.0)


@pytest.mark.parametrize("official", [True, False])
def test_anchors_look_back_on_the_longest_record(official):
    """The anchors are the smoothing board's, though others of the world stand beside them; of several versions the
    official one counts, whichever comes first."""
    others = [record("homogeneous", "filter", [0.5] * 3), record("true_model_smoother", "filter", [0.4] * 3)]
    mine = record("mine", "filter", REFERENCE)
    assert row([*others, *ANCHORS, mine], "mine", "filter")["skill"][0] == pytest.approx(1.0)
    assert row([*others, mine], "mine", "filter")["skill"][0] == pytest.approx((0.5 - 0.003) / 0.1)
    version = record("true_model_smoother", "smoothing", [0.001] * 3) | {"official": official}
    expected = (0.022 - 0.003) / (0.022 - (0.001 if official else 0.003))
    official_anchors = [anchor | {"official": not official} for anchor in ANCHORS]
    for records in ([version, *official_anchors], [*official_anchors, version]):
        assert row([*records, mine], "mine", "filter")["skill"][0] == pytest.approx(expected)


# -- worlds -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("id", "kwargs", "world"), [
    ("eitbench/Pipe2DFixedLag-v0", {"lag": 4}, "Pipe2D"),
    ("eitbench/Pipe3DSmoothing-v0", {"lag": "all", "world": None}, "Pipe3D"),
    ("eitbench/Pipe2D-v0", {"world": {"schedule": {"scored_steps": 3}}},
     "Pipe2D (schedule.scored_steps=3)"),
    ("eitbench/Pipe2DSmoothing-v0", {"world": {"region": None, "flow": {"diffusivity": 1e-3}}},
     "Pipe2D (flow.diffusivity=0.001, region=null)"),
    ("eitbench/Pipe2DUnknownVelocity-v0", {}, "Pipe2DUnknownVelocity"),
    ("eitbench/Pipe2DUnknownVelocity-v0", {"flow": "skewed"}, "Pipe2DUnknownVelocity (flow=skewed)"),
    ("eitbench/Pipe2DBiasedVelocity-v0", {"world": {"region": None}, "assume": {"profile": "plug"}, "episodes": 2},
     "Pipe2DBiasedVelocity (region=null)"),
    ("theirs/Tank-v1", {"size": (1.0, 2.0)}, "theirs/Tank-v1 (size=[1.0, 2.0])"),
])
def test_worlds_are_named(id, kwargs, world):
    """By the id without its lag, and by what was changed of the world; not by what is believed of it."""
    mine = record("mine", "filter", [0.1])
    mine["environment"] = {"id": id, "name": "x", "kwargs": kwargs}
    assert list(summary([mine])["world"]) == [world]


def test_beliefs_stand_beside_the_method():
    """Two rows of the same method and world are told apart by what it was made to believe."""
    rows = [record("mine", "filter", [0.1], kwargs={"assume": {"flow": "real"}, "lag": None}),
            record("mine", "filter", [0.2])]
    assert list(summary(rows)["method"]) == ["mine, assume.flow=real", "mine"]


def several():
    """Records of three worlds, one of them not ours, and dev seeds; shuffled."""
    return [record("d", "filter", [0.1], id="theirs/Tank-v0"), record("c", "filter", [0.1], id="eitbench/Pipe3D-v0"),
            record("b", "smoothing", [0.2]), record("e", "filter", [0.1]) | {"split": "dev"},
            record("a", "filter", [0.3])]


def test_world_by_world():
    """Reported seeds first, then the worlds as they were registered, then boards; what is not ours comes last."""
    assert list(summary(several())["baseline"]) == ["a", "b", "c", "d", "e"]


def test_the_environment_is_named_where_there_are_several():
    """The first column says which, in words as the next ones; with one world there is no such column."""
    text = said(shown(summary(several())))
    assert list(text.columns)[:4] == ["environment", "board", "method", "seeds"]
    assert list(text["environment"]) == ["Pipe2D", "Pipe2D", "Pipe3D", "theirs/Tank", "Pipe2D"]
    lines = shown(summary(several())).markdown().splitlines()
    assert lines[2].startswith("| Pipe2D      | filter") and lines[4].startswith("| Pipe3D      | filter")
    assert [cell.endswith(":") for cell in lines[1].strip("|").split("|")][:5] == [False] * 4 + [True]
    alone = shown(summary(ANCHORS)).markdown().splitlines()
    assert re.match(r"\| board +\| method +\| seeds +\| +ẽ_c \|", alone[0])
    assert [cell.endswith(":") for cell in alone[1].strip("|").split("|")][:4] == [False] * 3 + [True]


# -- table ------------------------------------------------------------------------------------------------------------


def test_best_first_board_by_board():
    """Filter, fixed-lag, smoothing; within a board by error, and last who has none."""
    records = [record("b", "smoothing", [0.2]), record("x", "filter", [0.1], failed=(0,)), record("c", "filter", [0.3]),
               record("a", "filter", [0.2]), record("d", "fixed-lag", [0.9]), record("e", "smoothing", [0.1])]
    table = summary(records)
    assert list(zip(table["board"], table["baseline"], strict=True)) == [
        ("filter", "a"), ("filter", "c"), ("filter", "x"), ("fixed-lag", "d"), ("smoothing", "e"), ("smoothing", "b")]


def test_failures_are_counted_not_averaged():
    """Scores are of the episodes that went well; the table says how many that were."""
    records = [record("mine", "filter", [0.1, 0.2, 9.9], failed=(2,)), record("bad", "filter", [1.0], failed=(0,))]
    assert scores_by_seed(records[0], "error") == {"test:0": 0.1, "test:1": 0.2}
    assert row(records, "mine", "filter")["error"][0] == pytest.approx(0.15)
    text = said(shown(summary(records)))
    assert list(text["seeds"]) == ["test:0-2, 1 failed", "test:0, 1 failed"] and text["ẽ_c"][1] == "–"


def test_units_of_the_table():
    """Time in ms, voltage discrepancy in mV²; what is not claimed is a dash."""
    text = said(shown(summary([record("mine", "filter", [0.1], seconds_per_step=0.0025, voltage_discrepancy=4e-6)])))
    assert (text["ms/step"][0], text["ẽ_V"][0], text["CRPS"][0]) == ("2.5", "4", "–")
    always = [name for name in explanations() if name not in ("ẽ_v", "injections")]
    assert list(text.columns) == ["board", "method", "seeds", *always]


def test_the_error_of_the_flow_stands_where_it_was_asked_for():
    """Its column is there if anybody has it, and a dash for all others, also for those who were scored before it."""
    old = record("old", "filter", [0.3])
    del old["episodes"][0]["scores"]["velocity_error"]
    rows = [record("mine", "filter", [0.1], velocity_error=0.02), record("theirs", "filter", [0.2]), old]
    text = said(shown(summary(rows)))
    assert list(text["ẽ_v"]) == ["0.02", "–", "–"]


def test_markdown_is_a_table():
    """Every line has the same number of cells and the same width, whatever a title contains."""
    odd = record("mine", "filter", [0.1, 0.2]) | {"title": "mine | yours"}
    lines = shown(summary([*ANCHORS, odd])).markdown().splitlines()
    assert len(lines) == 5 and re.fullmatch(r"[|:-]+", lines[1])
    assert len({len(line) for line in lines}) == 1
    assert len({len(re.findall(r"(?<!\\)\|", line)) for line in lines}) == 1


def test_seeds_are_named_by_their_ranges():
    """A reader sees which episodes a score stands for."""
    assert seed_ranges(["test:0", "test:1", "test:2", "test:7"]) == "test:0-2,7"
    assert seed_ranges(["dev:10", "dev:9"]) == "dev:9-10" and seed_ranges(["300001"]) == "300001"


def test_other_seeds_have_boards_of_their_own():
    """Dev scores stand under their own heading, and find no anchors for skill in those of other seeds."""
    mine = record("mine", "filter", FLOOR) | {"split": "dev"}
    table = summary([*ANCHORS, mine])
    assert list(table["split"]) == ["test", "test", "dev"]
    assert said(shown(table))["board"].iloc[-1] == "filter (dev seeds)"
    assert row([*ANCHORS, mine], "mine", "filter")["skill"] is None
