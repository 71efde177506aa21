"""Records that pose as what they are not: names that look alike, keys said twice, floors of their own."""

import json
import os

import pytest
from eitbench.bench import tracks
from eitbench.bench.contradictions import contradictions
from eitbench.bench.methods import MOST_BYTES, find_method
from eitbench.bench.names import folded, likeness
from eitbench.bench.records import file_name, read_record, read_sound_records, sealed
from eitbench.bench.verify import job_of
from eitbench.report.boards import boards, run_boards
from eitbench.report.site import collect, render

from tiny import BOARD_IDS, FILTER, RUN, record

FLOOR = [0.20, 0.24, 0.22, 0.26, 0.18, 0.30, 0.25, 0.21]


def put(folder, made, name=None, text=None):
    """Written as somebody else would."""
    path = folder / (name or file_name(made))
    path.write_text(text or json.dumps(made), encoding="utf-8")
    return path


@pytest.mark.parametrize("name", ["Kalman_Filter", "k\u0430lman_filter", "\uff4balman_filter", "kalman-filter",
                                  "ka1man_filter", "kalman_fi\u0332lter", "kalrnan_filter", "kalman\u00a0filter",
                                  "\u212aalman_filter", "maskable_ppo_seedO"])
def test_names_that_look_like_ours_are_refused(name):
    """Other alphabets, widths, cases, digits, marks and signs between."""
    id = "eitbench/Pipe2DInjectionBudget-v0" if name.startswith("mask") else None
    made = record(name, FLOOR, id=id, board="injection" if id else "filter")
    assert [wrong for wrong in contradictions(made) if "must not look like one of ours" in wrong]


@pytest.mark.parametrize("name", ["mine", "kalman_filter", "kalman_filter_2", "my kalman_filter", "\u03a9\u5361",
                                  "e\u0301", "a1", "-rf"])
def test_other_names_are_not(name):
    """Also the name itself, whose records are of versions or of files."""
    assert not contradictions(record(name, FLOOR))


@pytest.mark.parametrize("text", ["\u2800", "\u3164", " mine", "mine\u3000", "a" + "\u0300" * 5])
def test_names_and_titles_can_be_seen(text):
    """No blanks, none around it, no towers of marks."""
    for changes in ({"method": text}, {"title": text}):
        assert [wrong for wrong in contradictions(record("mine", FLOOR) | changes) if "can be seen" in wrong]


def test_nothing_is_said_twice(tmp_path):
    """A reader believes the first, JSON the last."""
    made = record("mine", FLOOR)
    text = json.dumps(made)
    assert read_record(put(tmp_path, made)) == made
    put(tmp_path, made, text='{"official": true, ' + text[1:])
    with pytest.raises(ValueError, match="an object must have no name twice"):
        read_record(tmp_path / file_name(made))


@pytest.mark.parametrize("field", ["checkpoint_sha256", "version", "method_sha256"])
def test_a_pattern_ends_where_the_text_does(field, tmp_path):
    """Python's $ also stands before a last newline."""
    made = record("mine", FLOOR)
    made = sealed(made | {field: (made[field] or "a" * 64) + "\n"})
    with pytest.raises(ValueError, match="is not valid"):
        read_record(put(tmp_path, made, name=file_name(made).replace("\n", "\\n")))


def of_schema_2(made):
    """As the format before had it."""
    content = {key: value for key, value in made.items() if key not in ("sha256", "version")}
    runs = [{key: value for key, value in run.items() if key != "source"} for run in made["runs"]]
    return sealed(content | {"schema": 2, "source": RUN["source"], "runs": runs, "version": made["method_sha256"][:8]})


def test_a_version_has_one_record(tmp_path):
    """Not a second one in the format before, whose file has another name."""
    ours = record("kalman_filter", FLOOR, version="v1", official=True)
    put(tmp_path, ours)
    forged = of_schema_2(record("kalman_filter", [0.001] * 8, version="v1", official=True))
    put(tmp_path, forged, name=f"eitbench-Pipe2D-v0--kalman_filter--{forged['version']}.json")
    found, complaints = read_sound_records(tmp_path)
    assert found == [ours] and len(complaints) == 1
    assert f"{forged['version']}.json is of the same version and the same split as another" in complaints[0]


def test_a_name_of_an_environment_stands_for_one(tmp_path, monkeypatch):
    """Its eight digits of a hash are soon found again."""
    monkeypatch.setattr(tracks, "named", lambda id, given: id.replace("/", "-") + "-deadbeef" * bool(given))
    id = BOARD_IDS["filter"]
    for method, lag in (("first", 3), ("second", 4)):
        kwargs = {"lag": lag}
        put(tmp_path, record(method, FLOOR, board="fixed-lag", finished="2025-01-01" if lag == 3 else "2025-01-02",
                             environment={"id": id, "name": tracks.named(id, kwargs), "kwargs": kwargs}))
    found, complaints = read_sound_records(tmp_path)
    assert [each["method"] for each in found] == ["first"]
    assert "gives other arguments to eitbench-Pipe2D-v0-deadbeef than another" in complaints[0]


@pytest.mark.skipif(os.name != "posix", reason="the files cannot stand beside each other")
def test_names_of_one_page_do_not_stand_beside_each_other(tmp_path):
    """On systems that do not tell cases or ways of writing apart one page would take the place of the other."""
    assert folded("\u00e9") == folded("E\u0301") and folded("a") != folded("b")
    assert likeness("\u0430_b") == likeness("A-B")
    for name, day in (("mine", 1), ("MINE", 2), ("other", 3)):
        put(tmp_path, record(name, FLOOR, finished=f"2025-01-0{day}"))
    found, complaints = read_sound_records(tmp_path)
    assert {each["method"] for each in found} == {"mine", "other"} and "MINE, mine" in complaints[0]


def test_a_file_of_the_floor_s_name_is_no_floor():
    """Nor an anchor of the skill: only versions are ours."""
    theirs, mine = record("homogeneous", [9.0] * 8, version="1"), record("mine", FLOOR)
    best = record("true_model_smoother", [0.1] * 8, role="reference")
    assert boards([theirs, mine])["gain"].isna().all()
    assert all(row.cells["skill"] is None for board in run_boards([theirs, mine, best]) for row in board.rows)


def test_a_csv_holds_no_formula():
    """What begins like one is text in the programs that open it."""
    made = record("=HYPERLINK(\"x\")", FLOOR, title="@SUM(1)")
    line = render(collect([made]))["leaderboard.csv"].splitlines()[1]
    assert "'=HYPERLINK" in line and ",'@SUM(1)," in line


def test_a_copy_of_ours_is_not_played_for_another(tmp_path):
    """A link to one of our files is one of ours; its numbers are no proof of a stranger's record."""
    path = tmp_path / "mine.py"
    path.symlink_to(find_method("homogeneous", "estimation"))
    made = record("mine", FLOOR) | {"environment": {"id": FILTER.id, "kwargs": {}, "name": FILTER.id.replace("/", "-")}}
    with pytest.raises(ValueError, match="is one of ours, and not mine"):
        job_of(made, str(path))
    assert job_of(record("homogeneous", FLOOR), str(find_method("homogeneous", "estimation")))


def test_a_method_s_file_is_not_too_large_to_be_read(tmp_path):
    """Here it costs nothing: it has a hole."""
    path = tmp_path / "mine.py"
    path.touch()
    os.truncate(path, MOST_BYTES + 1)
    with pytest.raises(ValueError, match="must have 256 MiB at most"):
        find_method(str(path), "estimation")
