"""Records: nothing passes that the schema forbids, nothing that was changed by hand, and what is written comes back."""

import hashlib
import json
import warnings

import jsonschema_rs
import pytest
from eitbench._files import shipped
from eitbench.bench.migrate import migrate
from eitbench.bench.quick import schema_text
from eitbench.bench.records import (
    BOARDS,
    file_name,
    newest,
    read_record,
    read_records,
    sealed,
    write_record,
)
from eitbench.bench.tracks import named

from tiny import RUN, episode, record, sha, strict

MINE = record("mine", [0.1, 0.25, None], parameters={"alpha": 0.1, "order": [1, 2], "β": 1e-22})


def changed(path, value, whole=MINE):
    """The record with one field, named as the messages name it, replaced; ``...`` deletes it."""
    copy = json.loads(json.dumps(whole))
    *parts, last = [int(part) if part.isdigit() else part for part in path.split(".")]
    inner = copy
    for part in parts:
        inner = inner[part]
    if value is ...:
        del inner[last]
    else:
        inner[last] = value
    return copy


def write_unchecked(folder, content, name=None):
    """A file as somebody might leave it."""
    folder.mkdir(exist_ok=True)
    path = folder / (name or file_name(content))
    path.write_text(json.dumps(content))
    return path


# -- round trip -------------------------------------------------------------------------------------------------------


def test_round_trip(tmp_path):
    """What was written is read, to the last bit, from a file named by environment, method and version."""
    path = write_record(tmp_path, MINE)
    assert path.name == f"eitbench-Pipe2D-v0--mine--{sha('mine1')[:8]}.json" and MINE["version"] == sha("mine1")[:8]
    assert read_record(path) == MINE == strict(path.read_text(encoding="utf-8"))
    assert read_records(tmp_path) == [MINE]
    before = path.read_bytes()
    write_record(tmp_path, dict(reversed(MINE.items())))
    assert path.read_bytes() == before and [file.name for file in tmp_path.iterdir()] == [path.name]
    assert before.decode().count("\n") < 40                            # a line each for fields, episodes and runs


def test_no_folder_and_an_empty_one(tmp_path):
    """There need not be any record."""
    assert read_records(tmp_path) == [] and read_records(tmp_path / "none") == []


def test_versions_and_splits_have_files_of_their_own(tmp_path):
    """Another version of the method, or other seeds, do not replace a record; another run of the library does."""
    other_code = RUN | {"source": sha("newer")}
    for each in (MINE, record("mine", [0.1], version="2"), record("mine", [0.1], version="v1"),
                 record("mine", {"dev:0": 0.1}), record("mine", [0.3], runs=[other_code])):
        write_record(tmp_path, each)
    assert len(read_records(tmp_path)) == 4
    assert MINE not in read_records(tmp_path)


def test_python_objects_are_written_as_json(tmp_path):
    """Numbers as keys and tuples become what they are on disk before they are hashed, so that the hash holds."""
    odd = MINE | {"parameters": {10: (1, 2), 9: None}}
    assert read_record(write_record(tmp_path, odd))["parameters"] == {"10": [1, 2], "9": None}
    with pytest.raises(ValueError, match="record cannot be written as JSON"):
        write_record(tmp_path, MINE | {"parameters": {"a": float("nan")}})
    with pytest.raises(ValueError, match="record cannot be written as JSON"):
        write_record(tmp_path, MINE | {"parameters": {"a": {1, 2}}})


def test_the_digest_is_what_the_schema_says():
    """sha256 of the JSON with sorted keys and no spaces, in UTF-8: anybody can compute it."""
    content = {key: value for key, value in MINE.items() if key != "sha256"}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    assert MINE["sha256"] == hashlib.sha256(text.encode()).hexdigest()


# -- what is refused --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("path", "value", "message"), [
    ("schema", 1, r"\$\.schema: 3 was expected"),
    ("source", sha("code"), "'source' was unexpected"),
    ("version", "1", r'\$\.version: "1" does not match'),
    ("version", "v0", r'\$\.version: "v0" does not match'),
    ("version", "deadbeef", r"\$\.version: must be v1, v2, … of ours, or begin as method_sha256 does"),
    ("version", ..., '"version" is a required property'),
    ("runs.0.source", ..., r'\$\.runs\[0\]: "source" is a required property'),
    ("title", ..., '"title" is a required property'),
    ("title", "", r"\$\.title: "),
    ("title", "Fine |\n| 1 | Forged |", r"\$\.title: "),
    ("title", "Fine\n", r"\$\.title: "),
    ("title", 121 * "x", r"\$\.title: .* is longer than 120"),
    ("method", "mine\n", r"\$\.method: "),
    ("board", "smooth", r'\$\.board: "smooth" is not one of'),
    ("role", "best", r'\$\.role: "best" is not one of'),
    ("official", "no", r'\$\.official: "no" is not of type "boolean"'),
    ("privileged", ..., '"privileged" is a required property'),
    ("method", "../mine", r'\$\.method: "../mine" does not match'),
    ("method_sha256", "5ha", r'\$\.method_sha256: "5ha" does not match'),
    ("checkpoint_sha256", "5ha", r"\$\.checkpoint_sha256: "),
    ("checkpoint_sha256", ..., '"checkpoint_sha256" is a required property'),
    ("split", "exam", r'\$\.split: "exam" does not match'),
    ("seeds", [], r"\$\.seeds: "),
    ("score", 1, "'score' was unexpected"),
    ("environment.id", "Pipe2D", r'\$\.environment\.id: "Pipe2D" does not match'),
    ("environment.name", "eitbench-Pipe3D-v0", r"\$\.environment\.name: must be eitbench-Pipe2D-v0, as id and"),
    ("environment.name", "eitbench-Pipe2D-v0-deadbeef", r"\$\.environment\.name: must be eitbench-Pipe2D-v0, as"),
    ("environment.kwargs", {"lag": 3}, r"\$\.environment\.name: must be eitbench-Pipe2D-v0-\w{8}, as id and"),
    ("environment.kwargs", None, r'\$\.environment\.kwargs: null is not of type "object"'),
    ("runs.0.commit", ..., r'\$\.runs\[0\]: "commit" is a required property'),
    ("runs.0.isolation", "jail", r'\$\.runs\[0\]\.isolation: "jail" is not one of'),
    ("runs.0.versions.torch", ..., r'\$\.runs\[0\]\.versions: "torch" is a required property'),
    ("runs.0.machine.matmul_seconds", 0.0, r"\$\.runs\[0\]\.machine\.matmul_seconds: 0.0 is less than"),
    ("runs.0.machine.processor", None, r'\$\.runs\[0\]\.machine\.processor: null is not of type "string"'),
    ("episodes.0.scores.error", -1.0, r"\$\.episodes\[0\]\.scores\.error: -1.0 is less than the minimum"),
    ("episodes.0.scores.error", None, r'\$\.episodes\[0\]\.scores\.error: null is not of type "number"'),
    ("episodes.0.scores.error", 0.05, r"\$\.episodes\[0\]\.scores\.error: must be the mean of step_errors"),
    ("episodes.0.scores.beauty", "much", r'\$\.episodes\[0\]\.scores\.beauty: "much" is not of type'),
    ("episodes.0.scores.Beauty", 1.0, r"\$\.episodes\[0\]\.scores: Additional properties are not allowed \('Beauty'"),
    ("episodes.0.scores.seconds_per_step", -1.0, r"\$\.episodes\[0\]\.scores\.seconds_per_step: -1.0 is less"),
    ("episodes.0.scores.seconds_per_step", ..., r'\$\.episodes\[0\]\.scores: "seconds_per_step" is a required'),
    ("episodes.0.scores", ..., r'\$\.episodes\[0\]: "scores" is a required property'),
    ("episodes.0.message", "all well", r"\$\.episodes\[0\]\.message: "),
    ("episodes.2.message", ..., r'\$\.episodes\[2\]: "message" is a required property'),
    ("episodes.2.scores", {"error": 0.1, "seconds_per_step": 0.1}, r"\$\.episodes\[2\]\.scores: "),
    ("episodes.1.finished", "yesterday", r'\$\.episodes\[1\]\.finished: "yesterday" does not match'),
    ("episodes.1.run", 1, r"\$\.episodes\[1\]\.run: there are only 1 runs"),
    ("episodes.1.seed", "test:0", r"\$\.seeds: must be those of the episodes"),
    ("seeds", ["test:0", "test:0", "test:2"], r'\$\.seeds: \["test:0","test:0","test:2"\] has non-unique elements'),
])
def test_violations_are_named(path, value, message, tmp_path):
    """Nothing is written, and nothing read, that is not of the format; the message names the file and the field."""
    wrong = changed(path, value)
    with pytest.raises(ValueError, match=message):
        write_record(tmp_path / "new", wrong)
    assert not (tmp_path / "new").exists()
    file = write_unchecked(tmp_path, sealed(wrong), "it.json")
    with pytest.raises(ValueError, match=message) as caught:
        read_records(tmp_path)
    assert str(file) in str(caught.value)


def test_splits_do_not_mix(tmp_path):
    """All seeds of a record are of its split."""
    mixed = changed("seeds", ["test:0", "dev:1", "test:2"], changed("episodes.1.seed", "dev:1"))
    with pytest.raises(ValueError, match=r"\$\.seeds: must all be of the split test"):
        write_record(tmp_path, mixed)


@pytest.mark.parametrize("seed", ["test:999999", "test:007", "200001", "train:100000", "99999999999"])
def test_seeds_have_one_name(seed, tmp_path):
    """Those that lie outside their split, or that have another name, are no episode's."""
    with pytest.raises(ValueError, match=rf"\$\.seeds: '{seed}' names no episode"):
        write_record(tmp_path, record("mine", {seed: 0.1}))
    for fine in ("test:99999", "300000"):
        write_record(tmp_path, record("mine", {fine: 0.1}))


@pytest.mark.parametrize("run", [RUN | {"dirty": True}, RUN | {"commit": None, "dirty": None}])
def test_official_is_what_a_commit_can_repeat(run, tmp_path):
    """Whoever has changed the code reports for himself."""
    for official in (False, True):
        mine = record("mine", [0.1], runs=[run], official=official)
        if official:
            with pytest.raises(ValueError, match=r"\$\.official: must be false where a run was not of a commit"):
                write_record(tmp_path, mine)
        else:
            write_record(tmp_path, mine)
    write_record(tmp_path, record("mine", [0.1], official=True))


@pytest.mark.parametrize(("old", "new"), [("0.25", "0.24"), ("test:1", "test:7"), ("An abacus", "A computer"),
                                          ('"official": false', '"official": true')])
def test_changes_by_hand_are_caught(old, new, tmp_path):
    """A better number, another seed, another machine: valid JSON of the format, but not what was written."""
    path = write_record(tmp_path, MINE)
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(ValueError, match=r"mine--\w+\.json was changed since it was written"):
        read_records(tmp_path)
    path.write_text(json.dumps(json.loads(text)), encoding="utf-8")    # layout is free
    assert read_records(tmp_path) == [MINE]


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[]", b"null", b'{"schema": NaN}'])
def test_what_is_no_record_is_refused(content, tmp_path):
    """Unlike a run's own episodes, published records must all be sound."""
    (tmp_path / "it.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"record .*it\.json (cannot be read|is not valid)"):
        read_records(tmp_path)


def test_a_file_has_its_content_s_name(tmp_path):
    """Nobody replaces a record by a file of another name, or has two of one thing."""
    path = write_record(tmp_path, MINE)
    path.rename(tmp_path / path.name.replace("mine", "yours"))
    with pytest.raises(ValueError, match=f"must have the name {file_name(MINE)}"):
        read_records(tmp_path)


# -- versions of environments -----------------------------------------------------------------------------------------


def test_other_versions_of_an_environment_are_set_aside(tmp_path):
    """A record of an id that is not registered is left out, and a warning names it; the others are read."""
    old = record("mine", [0.1], id="eitbench/Pipe2D-v99")
    path = write_record(tmp_path, old)
    write_record(tmp_path, MINE)
    with pytest.warns(UserWarning, match=r"no environment eitbench/Pipe2D-v99") as caught:
        assert read_records(tmp_path) == [MINE]
    assert str(path) in str(caught[0].message)
    path.unlink()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_records(tmp_path)


def test_only_the_highest_version_of_a_method_of_ours_is_current():
    """Each environment and split for itself, by number and not by letters; the code that played has no say."""
    v2, v10 = (record("a", [0.1], version=version, finished=when) for version, when in (
        ("v2", "2025-01-02"), ("v10", "2025-01-01")))
    tank = record("a", [0.1], id="eitbench/RotatingTank2D-v0", version="v1")
    dev = record("a", {"dev:0": 0.1}, version="v1")
    other = record("b", [0.1], version="v1", runs=[RUN | {"source": sha("other")}])
    assert newest([v2, tank, v10, dev, other]) == ([tank, v10, dev, other], [v2])
    assert newest([]) == ([], [])


def test_versions_of_strangers_stand_side_by_side():
    """Digits of a sha256 do not say which came first."""
    both = [record("mine", [0.1], version=version, finished=f"2025-01-0{version}") for version in "12"]
    assert newest(both) == (both, [])


# -- the schema -------------------------------------------------------------------------------------------------------


def test_the_schema_knows_all_that_there_is():
    """It is a sound schema itself, and has the boards of the code."""
    schema = json.loads(schema_text())
    assert jsonschema_rs.meta.is_valid(schema)
    assert schema["$schema"].endswith("2020-12/schema")
    assert tuple(schema["properties"]["board"]["enum"]) == BOARDS
    assert set(schema["required"]) == set(schema["properties"]) == set(MINE)
    assert set(episode("test:0", 0.1)) | {"message", "where"} == set(schema["$defs"]["episode"]["properties"])


def test_scores_are_open(tmp_path):
    """Whoever registers a score may write it: any name of small letters, with a finite number or null."""
    scores = {"error": 0.1, "seconds_per_step": 0.01, "missed_bubbles_2": -3.5, "nis": None}
    mine = record("mine", [0.1], scores={name: scores[name] for name in ("missed_bubbles_2", "nis")})
    assert read_record(write_record(tmp_path, mine))["episodes"][0]["scores"] == scores


# -- the format before ------------------------------------------------------------------------------------------------


def old(made, source="code", **changes):
    """A record as it was written in schema 2, with its own seal."""
    kept = {key: value for key, value in made.items() if key not in ("version", "sha256")}
    runs = [{key: value for key, value in run.items() if key != "source"} for run in made["runs"]]
    return sealed(kept | {"schema": 2, "source": sha(source), "runs": runs} | changes)


def write_old(folder, content):
    name = "--".join([content["environment"]["name"], content["method"], content["method_sha256"][:8]])
    return write_unchecked(folder, content, f"{name}.json")


@pytest.mark.parametrize(("method", "official", "version"), [
    ("kalman_filter", True, "v1"), ("kalman_filter", False, sha("kalman_filter1")[:8]),
    ("mine", True, sha("mine1")[:8])])
def test_records_of_the_format_before_are_read(method, official, version, tmp_path):
    """As they would be written today: the source is each run's, and official ones of ours are of version 1."""
    runs, episodes = [RUN, RUN | {"commit": "decaf"}], [episode("test:0", 0.1), episode("test:1", None) | {"run": 1}]
    made = record(method, [0.1, None], official=official, runs=runs, episodes=episodes)
    path = write_old(tmp_path, old(made))
    expected = made | {"version": version, "runs": runs}
    assert read_record(path) == sealed(expected) and read_records(tmp_path) == [sealed(expected)]


@pytest.mark.parametrize(("name", "kwargs", "expected"), [
    ("eitbench-Pipe2DFixedLag-v0", {"lag": 4}, {}),
    ("eitbench-Pipe2DFixedLag-v0-12345678", {"lag": 4, "assume": {"flow": "real"}}, {"assume": {"flow": "real"}}),
    ("eitbench-Pipe2DFixedLag-v0-12345678", {"lag": 3}, {"lag": 3})])
def test_arguments_of_the_registration_are_left_out(name, kwargs, expected, tmp_path):
    """What stays are those that somebody gave, and the name follows from them."""
    environment = {"id": "eitbench/Pipe2DFixedLag-v0", "name": name, "kwargs": kwargs}
    path = write_old(tmp_path, old(record("mine", [0.1], board="fixed-lag"), environment=environment))
    found = read_record(path)["environment"]
    assert found["kwargs"] == expected and found["name"] == named("eitbench/Pipe2DFixedLag-v0", expected)


def test_an_old_seal_and_an_old_name_still_count(tmp_path):
    """What was changed by hand, renamed or is not whole is refused as it always was."""
    path = write_old(tmp_path, old(MINE))
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("0.25", "0.24"), encoding="utf-8")
    with pytest.raises(ValueError, match="was changed since it was written"):
        read_record(path)
    path.write_text(text, encoding="utf-8")
    renamed = path.rename(tmp_path / "eitbench-Pipe2D-v0--mine--v1.json")
    with pytest.raises(ValueError, match=f"must have the name eitbench-Pipe2D-v0--mine--{sha('mine1')[:8]}.json"):
        read_record(renamed)
    for broken in (old(MINE) | {"runs": "none"}, {"schema": 2}, old(MINE) | {"environment": "Pipe2D"}):
        with pytest.raises(ValueError, match="is not valid"):
            read_record(write_unchecked(tmp_path, broken, "it.json"))


def test_migrating_keeps_every_number(tmp_path):
    """Old files are rewritten under their new names; what was new already is left as it is."""
    made = [record("homogeneous", [0.1, 0.25, None], official=True, scores={"nis": 1.0 / 3.0}), record("mine", [0.1])]
    before = [write_old(tmp_path, old(each)) for each in made]
    new = write_record(tmp_path, record("yours", [0.3]))
    content, read = new.read_bytes(), read_records(tmp_path)
    moved = list(migrate(tmp_path))
    assert [path for path, _ in moved] == sorted(before) and new.read_bytes() == content
    assert {path.name for path in tmp_path.iterdir()} == {
        "eitbench-Pipe2D-v0--homogeneous--v1.json", before[1].name, new.name}
    assert sorted(read_records(tmp_path), key=str) == sorted(read, key=str)
    for each in read_records(tmp_path):
        (same,) = [other for other in [*made, record("yours", [0.3])] if other["method"] == each["method"]]
        assert all(each[key] == same[key] for key in ("episodes", "seeds", "runs", "method_sha256"))
    assert list(migrate(tmp_path)) == []


def test_migrating_replaces_nothing_else(tmp_path):
    """Where the new place is taken by a record that says something else, everything stays as it is."""
    mine = record("homogeneous", [0.1], official=True)
    write_old(tmp_path, old(mine))
    write_record(tmp_path, record("homogeneous", [0.2], official=True, version="v1"))
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(ValueError, match=r"must not hold two records of one thing, but .*homogeneous--v1\.json"):
        list(migrate(tmp_path))
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_two_old_records_of_one_method_are_not_migrated_over_each_other(tmp_path):
    """Of two files of a method of ours both would be its v1: they are named, and stay as they are."""
    for text in ("one", "two"):
        write_old(tmp_path, old(record("homogeneous", [0.1], official=True, method_sha256=sha(text))))
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert len(before) == 2
    with pytest.raises(ValueError, match=r"both become eitbench-Pipe2D-v0--homogeneous--v1\.json") as caught:
        list(migrate(tmp_path))
    assert all(path.name in str(caught.value) for path in before)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_the_published_records_are_of_today():
    """Nobody has to upgrade what the repository holds."""
    texts = [path.read_text() for path in (shipped("leaderboards") / "results").glob("*.json")]
    assert len(texts) >= 165 and all(json.loads(text)["schema"] == 3 for text in texts)
