"""The robustness board: errors, ratios, gains and marks are those that can be worked out by hand from the records."""

import pytest
from eitbench.bench.table import NOTHING
from eitbench.report.boards import ALL, boards
from eitbench.report.site import render, render_site
from eitbench.report.site.collect import ROBUSTNESS, collect
from eitbench.report.site.robustness import families, heading, robustness_table
from eitbench.worlds import register
from eitbench.worlds.catalogue import PIPE_2D

from short import register_apart
from tables import said
from tiny import BOARD_IDS, record

HOME, SHORT, NOISE = BOARD_IDS["filter"], "eitbench/Pipe2DShortSlugs-v0", "eitbench/Pipe2DDoubleNoise-v0"
FLOOR = {"role": "floor", "official": True}


def several() -> list[dict]:
    """At home and under two shifts: `steady` gains most where it is worst, `tuned` falls below the floor."""
    floors = [record("homogeneous", [level] * 4, id=id, **FLOOR)
              for id, level in ((HOME, 0.2), (SHORT, 0.1), (NOISE, 0.2))]
    others = {"steady": (0.10, 0.06, 0.12), "tuned": (0.02, 0.09, 0.30), "other": (0.10, 0.08, 0.02)}
    played = [record(name, [error] * 4, id=id) for name, errors in others.items()
              for id, error in zip((HOME, SHORT, NOISE), errors, strict=True)]
    return [*floors, *played, record("persistence", [0.25] * 4, id=NOISE, version="v1", **FLOOR)]


def table(records):
    """The one family's board as text, by the method's name."""
    (family,) = families(collect(records, boards(records)))
    shown = said(robustness_table(family))
    return shown.set_index(shown["method"].str.extract(r"(\w+)@")[0].rename("name"))


def test_numbers_are_those_of_the_records():
    shown = table(several())
    assert list(shown.columns) == ["method", "home", "short slugs", "double noise", "most", "mean gain", "least gain"]
    assert list(shown.loc["steady"])[1:] == ["0.1", "0.06 × 0.6", "0.12 × 1.2", "× 1.2 double noise", "0.4",
                                             "0.4 short slugs"]
    assert list(shown.loc["other"])[1:] == ["0.1", "0.08 × 0.8", "0.02 × 0.2", "× 0.8 short slugs", "0.55",
                                            "0.2 short slugs"]


def test_the_first_gains_most_where_it_gains_least():
    """Not who errs least at home, nor on average; who has not played all shifts is last."""
    assert list(table(several()).index) == ["steady", "other", "homogeneous", "tuned", "persistence"]


def test_who_is_worse_than_the_best_floor_is_marked():
    """In that shift; a floor that is worse than another is not."""
    shown = table(several())
    assert shown.loc["tuned", "double noise"] == "0.3 × 15 (below the floor)"
    assert [cell for cell in shown.to_numpy().ravel() if "below" in cell] == ["0.3 × 15 (below the floor)"]
    better = record("persistence", [0.11] * 4, id=NOISE, version="v1", **FLOOR)
    marked = table([*several()[:-1], better])["double noise"].str.contains("below")
    assert set(marked[marked].index) == {"tuned", "steady"}
    stranger = record("mine", [1e-9] * 4, id=NOISE, role="floor")                  # and may call himself a floor
    assert table([*several(), stranger])["double noise"].str.contains("below").sum() == 1


def test_what_is_missing_is_blank():
    """A shift, the home, the floor, an episode, or all of them."""
    shown = table([each for each in several() if (each["method"], each["environment"]["id"]) != ("tuned", SHORT)])
    assert list(shown.loc["tuned"])[2:] == [NOTHING, "0.3 × 15 (below the floor)", NOTHING, NOTHING, NOTHING]
    nobody_home = table([each for each in several() if each["environment"]["id"] != HOME])
    assert set(nobody_home["home"]) == {NOTHING} and nobody_home.loc["steady", "short slugs"] == "0.06"
    no_floor = table([each for each in several() if each["role"] is None])
    assert "least gain" not in no_floor and not no_floor["double noise"].str.contains("below").any()
    failing = table([*several(), record("bad", [0.1, None, None, None], id=SHORT),
                     record("worse", [None] * 4, id=SHORT)])
    assert failing.loc["bad", "short slugs"] == "0.1 (3 failed)" and failing.loc["bad", "least gain"] == NOTHING
    assert failing.loc["worse", "short slugs"] == f"{NOTHING} (4 failed)"


def test_without_shifts_there_is_no_board():
    """Neither page nor section, nor a link to it."""
    records = [record("homogeneous", [0.2] * 2, **FLOOR), record("steady", [0.1] * 2)]
    for played in ([], records):
        files = render_site(played, boards(played))
        assert ROBUSTNESS not in files and ROBUSTNESS not in files["index.html"].decode()
        assert "## robustness" not in render(played)["leaderboard.md"]


def test_it_is_on_the_site_and_in_the_text():
    """Linked from the first page and from each shift's; it says what has changed."""
    records = several()
    files = {path: page.decode() for path, page in render_site(records, boards(records)).items()}
    html, text = files[ROBUSTNESS], render(records)["leaderboard.md"]
    assert f'href="{ROBUSTNESS}"' in files["index.html"]
    for id in (SHORT, NOISE):
        name = id.replace("/", "-")
        assert f'href="environments/{name}.html"' in html
        assert f'href="../{ROBUSTNESS}"' in files[f"environments/{name}.html"]
    assert f'href="../{ROBUSTNESS}"' not in files[f"environments/{HOME.replace('/', '-')}.html"]
    assert "Slugs pass in half the time" in html and "below the floor" in html and "told the true flow" in html
    assert "0.3 × 15 (below the floor)" in text[text.index("## robustness"):]


def test_shifts_do_not_count_in_aggregates():
    """Else one pipe would count as many; who has played no shift stays there."""
    tank = "eitbench/RotatingTank2D-v0"
    records = [*several(), *(record(name, [0.1] * 4, id=tank, **more) for name, more in (
        ("homogeneous", FLOOR), ("steady", {}), ("plain", {}))), record("plain", [0.1] * 4)]
    rows = boards(records)
    assert set(rows[rows["environment"] == ALL]["method"]) == {"homogeneous", "steady", "plain"}


def test_a_family_of_somebody_else(monkeypatch):
    """Worlds of a package have a board of their own, beside ours."""
    register_apart(monkeypatch)
    weak = PIPE_2D.changed({"target": {"strength": [0.1, 0.2]}})
    register(weak, "me/Weak-v0", about="Slugs are weak.")
    register(weak.changed({"instrument": {"contact_spread": 0.3}}), "me/WeakWorn-v0", home="me/Weak-v0")
    records = [*several(), record("steady", [0.1] * 4, id="me/Weak-v0"),
               record("steady", [0.3] * 4, id="me/WeakWorn-v0")]
    ours, theirs = families(collect(records, boards(records)))
    assert (ours.home, theirs.home) == (HOME, "me/Weak-v0")
    assert list(said(robustness_table(theirs)).iloc[0])[1:] == ["0.1", "0.3 × 3"]


@pytest.mark.parametrize(("id", "home", "expected"), [
    (SHORT, HOME, "short slugs"), ("me/WeakWorn-v0", "me/Weak-v0", "worn"), ("me/Other-v0", HOME, "me/other")])
def test_headings(id, home, expected):
    assert heading(id, home) == expected
