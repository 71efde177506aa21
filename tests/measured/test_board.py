"""The measured board: records hold what was played and no data, nothing played is lost, and what is false is named."""

import json
import math

import numpy as np
import pytest
import yaml
from eitbench.bench import measured_records
from eitbench.bench.measured import play_record
from eitbench.bench.measured_cases import SEEDS, Case, file_sha256, read_case
from eitbench.bench.measured_records import read_measured_record, sealed, submit_measured, validator
from eitbench.data.measured import Measurements
from eitbench.report import submission
from eitbench.report.site.measured import Measured, all_cases_table, case_table
from tanks import VESSEL, moving

from commands import eitbench
from tiny import git_says, record, write_baseline

WORDS = {"title": "A body moved round", "file": "moving.h5", "licence": "CC0", "source": "our simulator"}


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """A folder of leaderboards, with a record of a floor and one of somebody else's method; and the data."""
    folder = tmp_path_factory.mktemp("measured")
    data = moving(frames=3).save(folder / "moving.h5")
    boards = folder / "leaderboards"
    write_case(boards / "measured" / "moving.yml", data)
    mine = write_baseline(folder, "mine", update="return Estimate(1.1 * self.level)")
    code, said, err = eitbench("submit-measured", boards / "measured/moving.yml", "--data", data,
                               "--baseline", "homogeneous", "--baseline", mine)
    assert code == 0, err
    assert "wrote" in said
    return boards


@pytest.fixture
def case(played):
    return read_case(played / "measured" / "moving.yml")


def write_case(path, data, **changes):
    path.parent.mkdir(parents=True, exist_ok=True)
    said = WORDS | {"sha256": file_sha256(data), "vessel": VESSEL} | changes
    path.write_text(yaml.safe_dump(said), encoding="utf-8")


def of(played, method):
    (path,) = (played / "measured").glob(f"moving--{method}--*.json")
    return path


def test_a_part_of_a_record_is_a_case(played, tmp_path):
    """It is the record's part, and another case than the whole."""
    data = played.parent / "moving.h5"
    whole = read_case(played / "measured" / "moving.yml")
    frame = whole.env(data).record.frame
    write_case(tmp_path / "moving.yml", data, span=[frame, 3 * frame])
    part = read_case(tmp_path / "moving.yml")
    assert part.digest != whole.digest
    np.testing.assert_array_equal(part.env(data).record.readings, whole.env(data).record.readings[frame:3 * frame])
    for wrong in ("0:800", [5, 5], [-1, 4], [0.5, 2]):
        write_case(tmp_path / "moving.yml", data, span=wrong)
        with pytest.raises(ValueError, match=r"case\.span must be two numbers such as \[0, 800\]"):
            read_case(tmp_path / "moving.yml")


def test_record_says_what_was_played(played, case):
    """Its numbers are those of the plays, and the data are known by sha256 and licence alone."""
    said = read_measured_record(of(played, "homogeneous"))
    env = case.env(played.parent / "moving.h5")
    for play in said["plays"]:
        again = play_record(env, "homogeneous", play["seed"])
        assert play["withheld"] == pytest.approx(again.withheld, rel=1e-12)
        assert play["readings"] == 24
    assert [play["seed"] for play in said["plays"]] == list(SEEDS)
    assert len({play["withheld"] for play in said["plays"]}) == len(SEEDS)
    assert said["file_sha256"] == file_sha256(played.parent / "moving.h5")
    assert said["licence"] == "CC0"
    assert said["role"] == "floor"
    assert not said["official"]
    assert set(said) == set(json.loads(json.dumps(said))) and len(json.dumps(said)) < 4000


def test_an_interrupted_run_resumes(played, case, tmp_path, monkeypatch):
    """What was played stays, is not played again, and makes the same record in the end."""
    data = played.parent / "moving.h5"
    play = measured_records.play_again
    seeds = []

    def until_the_third(env, method, seed, *truth):
        if len(seeds) == 2:
            raise KeyboardInterrupt
        seeds.append(seed)
        return play(env, method, seed, *truth)

    monkeypatch.setattr(measured_records, "play_again", until_the_third)
    with pytest.raises(KeyboardInterrupt):
        submit_measured(case, data, "homogeneous", tmp_path)
    (path,) = tmp_path.glob("*.json")
    assert [each["seed"] for each in read_measured_record(path)["plays"]] == [0, 1]
    seeds.clear()
    monkeypatch.setattr(measured_records, "play_again", lambda *given: seeds.append(given[2]) or play(*given))
    submit_measured(case, data, "homogeneous", tmp_path)
    assert seeds == [2, 3, 4]
    whole, resumed = (read_measured_record(each)["plays"] for each in (of(played, "homogeneous"), path))
    assert [each["withheld"] for each in whole] == [each["withheld"] for each in resumed]


def test_other_data_are_refused(played, case, tmp_path):
    """Before anything is played or written: of one reading that is another, too."""
    record = Measurements.load(played.parent / "moving.h5")
    readings = record.readings.copy()
    readings[3, 3] *= 1.0 + 1e-9
    other = Measurements(record.currents, record.injections, record.matrix, readings, record.times,
                         record.reference, record.source).save(tmp_path / "moving.h5")
    code, _, err = eitbench("submit-measured", played / "measured/moving.yml", "--data", other, "--baseline",
                            "homogeneous", "--to", tmp_path / "to")
    assert code == 2
    assert "sha256" in err
    assert not (tmp_path / "to").exists()


@pytest.mark.parametrize(("change", "word"), [
    ({"licence": ""}, "case.licence"), ({"sha256": "abc"}, "case.sha256"), ({"vessel": 3}, "case.vessel"),
    ({"frames": 3}, "case has no frames"), ({"beside": {"ref.mat": "1"}}, "case.ref.mat")])
def test_a_case_that_is_none_is_explained(played, tmp_path, change, word):
    write_case(tmp_path / "a.yml", played.parent / "moving.h5", **change)
    with pytest.raises(ValueError, match=word):
        read_case(tmp_path / "a.yml")


def test_a_missing_entry_is_named(tmp_path):
    (tmp_path / "a.yml").write_text("title: nothing else", encoding="utf-8")
    with pytest.raises(ValueError, match=r"must have file, sha256, licence, source, vessel"):
        read_case(tmp_path / "a.yml")


def test_what_a_reader_takes_from_beside_is_the_cases_too(played, tmp_path):
    """Another file of that name is refused."""
    data = played.parent / "moving.h5"
    here = tmp_path / "moving.h5"
    here.write_bytes(data.read_bytes())
    (tmp_path / "ref.mat").write_bytes(b"empty tank")
    write_case(tmp_path / "a.yml", data, beside={"ref.mat": file_sha256(tmp_path / "ref.mat")})
    case = read_case(tmp_path / "a.yml")
    assert case.env(here).record.currents.shape == (8, 8)
    (tmp_path / "ref.mat").write_bytes(b"a body in it")
    with pytest.raises(ValueError, match=r"ref\.mat must be"):
        case.env(here)


def falsified(path, **changes):
    """The record there, changed and sealed again."""
    content = read_measured_record(path) | changes
    path.write_text(json.dumps(sealed(content)), encoding="utf-8")


@pytest.fixture
def theirs(played, tmp_path):
    """A copy of the board, to be spoilt."""
    folder = tmp_path / "leaderboards" / "measured"
    folder.mkdir(parents=True)
    for path in (played / "measured").iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    return folder.parent


def test_a_true_record_is_verified_and_a_false_one_is_named(played, theirs):
    data = played.parent / "moving.h5"
    path = of(theirs, "homogeneous")
    assert eitbench("verify", path, "--data", data, "--seed", 3)[0] == 0
    plays = read_measured_record(path)["plays"]
    plays[3]["withheld"] *= 0.999
    falsified(path, plays=plays)
    code, _, err = eitbench("verify", path, "--data", data, "--seed", 3)
    assert code == 1
    assert "withheld is" in err


def test_what_is_no_record_is_left_out_and_named(theirs):
    """A number changed by hand, and a record of a case that has changed since."""
    path = of(theirs, "homogeneous")
    path.write_text(path.read_text("utf-8").replace('"official": false', '"official": true'), "utf-8")
    measured = Measured.of(theirs)
    assert [record["method"] for record in measured.records["moving"]] == ["mine"]
    assert len(measured.complaints) == 1
    assert "changed since it was written" in measured.complaints[0]
    case = theirs / "measured" / "moving.yml"
    case.write_text(case.read_text("utf-8").replace("radius: 0.1", "radius: 0.2"), "utf-8")
    measured = Measured.of(theirs)
    assert not measured.records
    assert "has changed since" in measured.complaints[1]


def test_words_of_a_case_may_be_mended(theirs):
    case = theirs / "measured" / "moving.yml"
    case.write_text(case.read_text("utf-8").replace("A body moved round", "A ball moved round"), "utf-8")
    assert Measured.of(theirs).cases["moving"].title == "A ball moved round"


def test_boards_are_those_worked_out_by_hand():
    """Order by the mean of what is missed; over the floor the geometric mean of the cases that were played."""
    def said(case, method, missed, role=None):
        plays = [{"seed": seed, "withheld": value, "nis": None, "seconds": 1.0, "readings": 100}
                 for seed, value in enumerate(missed)]
        return {"case": case, "method": method, "version": "v1", "title": method, "role": role,
                "official": True, "plays": plays}

    cases = {name: Case(name, name, "a", "0" * 64, "CC0", "here", {}) for name in "ab"}
    records = {"a": [said("a", "good", [1.0, 2.0, 3.0]), said("a", "floor", [8.0], "floor")],
               "b": [said("b", "good", [1.0]), said("b", "late", [3.0]), said("b", "floor", [4.0], "floor")]}
    measured = Measured(cases, records, [])
    assert [[cell.plain for cell in row.cells] for row in case_table(measured, "a").rows] == [
        ["good good@v1", "2 1 to 3", "10"], ["floor floor@v1 (floor)", "8 8 to 8", "10"]]
    rows = [[cell.plain for cell in row.cells] for row in all_cases_table(measured).rows]
    assert [row[0].split("@")[0] for row in rows] == ["good", "floor", "late"]
    assert [float(row[-1]) for row in rows] == [0.25, 1.0, 0.75]
    assert math.isclose(0.25, math.sqrt(2 / 8 * 1 / 4))
    assert rows[2][1] == "–"


def test_page_and_text_show_the_board(played, tmp_path):
    """Beside the other boards, and strangers' words as text."""
    from eitbench.bench.records import write_record
    folder = tmp_path / "leaderboards"
    write_record(folder / "results", record("homogeneous", [0.2, 0.3], role="floor"))
    (folder / "measured").mkdir()
    for path in (played / "measured").iterdir():
        (folder / "measured" / path.name).write_bytes(path.read_bytes())
    falsified(of(folder, "mine"), title="<b>mine</b>")
    assert eitbench("leaderboard", "--records", folder / "results")[0] == 0
    page = (folder / "site" / "measured.html").read_text("utf-8")
    text = (folder / "leaderboard.md").read_text("utf-8")
    assert 'href="measured.html"' in (folder / "site" / "index.html").read_text("utf-8")
    assert "&lt;b&gt;mine&lt;/b&gt;" in page
    assert "<b>mine" not in page
    assert "## measured" in text
    missed = np.mean([play["withheld"] for play in read_measured_record(of(folder, "homogeneous"))["plays"]])
    assert f"{missed:.3g}" in text[text.index("## measured"):]


def test_maintainers_are_told_of_false_claims(played, theirs, monkeypatch):
    git_says(monkeypatch, "c0ffee")
    for folder in (played, theirs):
        (folder / "results").mkdir(exist_ok=True)
    falsified(of(theirs, "mine"), official=True)
    case = theirs / "measured" / "moving.yml"
    case.write_text(case.read_text("utf-8").replace("radius: 0.1", "radius: 0.2"), "utf-8")
    (found,) = [each for each in submission.check(theirs, played, submission.Asked()) if each.what == "Measured data"]
    assert len(found.problems) == 2
    assert "calls itself official" in found.problems[0]
    assert "is there already with another content" in found.problems[1]


def test_published_schema_takes_no_other_fields(played):
    said = read_measured_record(of(played, "mine"))
    assert validator().is_valid(said)
    assert not validator().is_valid(said | {"readings": [1.0]})
