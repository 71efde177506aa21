"""Scores: their formulas, their required fields, and the display of a new score."""

import csv
import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from eitbench.bench import scores
from eitbench.bench.records import read_record
from eitbench.bench.scores import Outcome, Score, compute_scores, register_score
from eitbench.report import compare
from eitbench.report.boards import run_leaderboards
from eitbench.report.site import collect, render, render_site
from eitbench.report.tables import run_table
from eitbench.worlds import entry

from tiny import said

PUBLISHED = Path(__file__).parents[2] / "leaderboards" / "results"
WORLD = entry("eitbench/Pipe2D-v0").world


@pytest.fixture
def apart(monkeypatch):
    monkeypatch.setattr(scores, "_scores", dict(scores.scores()))


def outcome(**given):
    """Two states of two nodes with estimation errors (1, 0) and (0, 2), at masses 1 and 3."""
    truth = np.array([[4.0, 2.0], [4.0, 2.0]])
    return Outcome(WORLD, 0.5, np.array([0.1, 0.3]), mean=truth + np.diag([1.0, 2.0]), truth=truth,
                   mass=np.diag([1.0, 3.0]), points=np.zeros((2, 2)), homogeneous=3.0, **given)


@pytest.mark.parametrize(("track", "given", "expected"), [
    # the mean of the steps' errors; the contrast is 1/4 and 12/4 of ∫(c − 3)² = 4
    ("estimation", {}, {"error": 0.2, "seconds_per_step": 0.5, "contrast_error": 0.5 * (1 / 4 + 12 / 4),
                        **dict.fromkeys(("nis", "crps", "coverage_50", "velocity_error"))}),
    # ν = (2, 0) with S = diag(1, 4); a velocity that is 10 % too high everywhere
    ("estimation", {"innovations": (np.array([[2.0, 0.0]]), np.diag([1.0, 4.0])[None]),
                    "velocity": (np.full((2, 3), 1.1), np.ones((2, 3)), np.full(3, 0.2))},
     {"nis": 2.0, "velocity_error": 0.01}),
    # two accepted measurements and then one: (4/1 + 4/4)/2 = 2.5 and 9/1 = 9
    ("injection", {"innovations": ([np.array([2.0, 2.0]), np.array([3.0])], [np.diag([1.0, 4.0]), np.eye(1)])},
     {"nis": 5.75}),
    # flows (3, 6) mol/s of true (4, 3): RMS √(10/25), amount 9 of 7
    ("estimation", {"solute_flow": (np.array([3.0, 6.0]), np.array([4.0, 3.0]))},
     {"solute_flow_error": 0.4**0.5, "solute_amount_error": 2 / 7, "arrival_error": None,
      "solute_flow_coverage_90": None, "section_error": None, "energy_score": None}),
    # the 90 % interval has ± 1.645 standard deviations: 1.64 are inside, 1.66 are not
    ("estimation", {"solute_flow": (np.array([3.0, 6.0]), np.array([4.64, 7.66])), "solute_flow_std": np.ones(2)},
     {"solute_flow_coverage_90": 0.5}),
    # sections (3, 4) mol/m³ of true (3, 2), in one of two states; without uncertainty the energy score is the RMS error
    ("estimation", {"sections": (np.array([[3.0, 4.0], [3.0, 2.0]]), np.full((2, 2), [3.0, 2.0])),
                    "section_covariance": np.zeros((2, 2, 2))},
     {"section_error": 2.0 / 26**0.5, "energy_score": 0.5 * 2.0 / 2**0.5}),
    # a slug is estimated one step late, and ends in time
    ("estimation", {"solute_flow": (np.array([0.0, 0, 0, 2, 0, 0, 0]), np.array([0.0, 0, 2, 2, 0, 0, 0]))},
     {"arrival_error": WORLD.time_step, "duration_error": WORLD.time_step}),
    # distances 1, 3 and 50 mm: the median is 3 mm, and a third of the states are lost
    ("injection", {"distances": np.array([0.001, 0.05, 0.003]), "ospa": 0.02},
     {"position_error": 0.003, "lost_fraction": 1 / 3, "ospa": 0.02}),
    # areas of 1 m² too much and too little, of 3 and 4 m²
    ("injection", {"areas": (np.array([4.0, 3.0]), np.array([3.0, 4.0]))}, {"area_error": 2**0.5 / 5}),
])
def test_numbers_by_hand(track, given, expected):
    """Scores equal their formulas; without data they are None."""
    said = compute_scores(track, outcome(**given))
    assert {name: said[name] for name in expected} == pytest.approx(expected)
    assert ("spent" in said) == (track == "injection")


WORST = Score("worst_step", "worst", "the worst step", lambda outcome: outcome.errors.max(), factor=100.0)


def test_a_new_score_is_shown_everywhere(apart):
    """After one call it is in episodes, summaries, CSV, Markdown, pages and comparisons, in its unit. Scores without a
    direction are not compared."""
    records = [read_record(path) for method in ("homogeneous", "kalman_filter")
               for path in PUBLISHED.glob(f"eitbench-Pipe2D-v0--{method}--*.json")]
    for record in records:
        for episode in record["episodes"]:
            episode["scores"]["worst_step"] = max(episode["step_errors"])
    register_score(WORST)
    assert compute_scores("estimation", outcome())["worst_step"] == pytest.approx(0.3)
    expected = {record["method"]: 100.0 * np.mean([max(episode["step_errors"])
                                                   for episode in record["episodes"]]) for record in records}
    assert "worst" in run_table(run_leaderboards(records)[0]).headings
    made = render(collect(records))
    rows = {row["method"]: row for row in csv.DictReader(io.StringIO(made["leaderboard.csv"]))}
    for method, value in expected.items():
        assert 100.0 * float(rows[method]["worst_step"]) == pytest.approx(value, rel=1e-5)
    assert "| worst |" in made["leaderboard.md"] and "**worst**: the worst step" in made["leaderboard.md"]
    site = render_site(collect(records))
    assert "the worst step" in site["environments/eitbench-Pipe2D-v0.html"].decode()
    table = compare.compare(records[1:], records[:1], "worst_step")
    assert table["a"][0] == pytest.approx(expected["kalman_filter"]) and table["better"][0] == 1.0
    assert said(compare.comparison_table(table, "worst_step"))["better"][0] == "A"
    scores._scores["worst_step"] = replace(WORST, direction="higher")
    assert compare.compare(records[1:], records[:1], "worst_step")["better"][0] == 0.0
    for name in ("nis", "voltage_discrepancy", "beauty"):
        with pytest.raises(ValueError, match=f"score must be one of .*_error.*; got '{name}'"):
            compare.compare(records[1:], records[1:], name)


@pytest.mark.parametrize(("changes", "message"), [
    ({"name": "My score"}, "name must be of lower-case"),
    ({"name": "error"}, "has the name or heading of another, error"),
    ({"better": "more"}, "direction must be one of lower, higher"),
    ({"tracks": ("sprint",)}, "each of tracks must be one of estimation, injection, measured; got 'sprint'"),
    ({"factor": 0.0}, "factor must be")])
def test_invalid_scores_are_rejected(changes, message, apart):
    """Nothing is registered. A score that is not a number is rejected with its name; None is an undefined score."""
    before = list(scores.scores())
    given = {"name": "mine", "heading": "mine", "explanation": "", "compute": lambda outcome: 0.0} | changes
    with pytest.raises(ValueError, match=message):
        register_score(Score(**given))
    assert list(scores.scores()) == before
    register_score(Score("mine", "mine", "", lambda outcome: np.nan))
    with pytest.raises(ValueError, match="score mine"):
        compute_scores("estimation", outcome())
    register_score(Score("yours", "yours", "", lambda outcome: None))
    assert scores.scores()["yours"](outcome()) is None
