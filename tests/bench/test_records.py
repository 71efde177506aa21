"""Records: files that break the schema or were edited are rejected, and records are read as they were written."""

import hashlib
import json
import os

import jsonschema_rs
import pytest
from eitbench._files import bundled_path
from eitbench.bench.records import (
    MAX_BYTES,
    MAX_RECORD_DEPTH,
    read_record,
    read_records,
    split_outdated,
    with_content_hash,
    write_record,
)
from eitbench.bench.tracks import ALL_SUBTRACKS, environment_name, subtrack_of_id
from eitbench.worlds import entry

from tiny import RUN, episode, record, sha, strict

MINE = record("mine", [0.1, 0.25, None], parameters={"alpha": 0.1, "order": [1, 2], "β": 1e-22},
              scores={"missed_bubbles_2": -3.5, "nis": None})      # names of scores are arbitrary


def changed(path, value, whole=MINE):
    """Return the record with one field, in the notation of the messages, replaced; ``...`` deletes it."""
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


def test_round_trip(tmp_path):
    """The file that is read equals what was written, to the last bit; environment, method and version name it. The
    hash is the sha256 of the JSON with sorted keys and no spaces, in UTF-8, and numeric keys and tuples are converted
    to JSON types before."""
    content = {key: value for key, value in MINE.items() if key != "sha256"}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    assert MINE["sha256"] == hashlib.sha256(text.encode()).hexdigest()
    assert read_records(tmp_path) == [] and read_records(tmp_path / "none") == []
    path = write_record(tmp_path, MINE)
    assert path.name == f"eitbench-Pipe2D-v0--mine--{sha('mine1')[:8]}.json" and MINE["version"] == sha("mine1")[:8]
    assert read_record(path) == MINE == strict(path.read_text(encoding="utf-8"))
    assert read_records(tmp_path) == [MINE]
    before = path.read_bytes()
    write_record(tmp_path, dict(reversed(MINE.items())))
    assert path.read_bytes() == before and [file.name for file in tmp_path.iterdir()] == [path.name]
    assert before.decode().count("\n") < 40                            # one line for each field, episode and run
    odd = MINE | {"parameters": {10: (1, 2), 9: None}}
    assert read_record(write_record(tmp_path, odd))["parameters"] == {"10": [1, 2], "9": None}
    for value in (float("nan"), {1, 2}):
        with pytest.raises(ValueError, match="record cannot be written as JSON"):
            write_record(tmp_path, MINE | {"parameters": {"a": value}})


@pytest.mark.parametrize(("path", "value", "message"), [
    ("schema", 1, r"\$\.schema: 3 was expected"),
    ("version", "deadbeef", r"\$\.version: must be v1, v2, … or the first eight digits of method_sha256"),
    ("title", "a\u202eb", r"\$\.title: .* is not allowed"),
    ("board", "smooth", r'\$\.board: "smooth" is not one of'),
    ("method", "../mine", r'\$\.method: "../mine" does not match'),
    ("score", 1, "'score' was unexpected"),
    ("episodes.1.step_errors", [0.25, 0.25], r"\$\.episodes: must have the same number of step_errors each"),
    ("checkpoint_sha256", "a" * 64 + "\n", r"\$\.checkpoint_sha256: "),           # Python's $ matches before a line end
    ("episodes.0.scores.nis", 1e51, r"\$\.episodes\[0\]\.scores\.nis: 1e\+51 is greater than the maximum"),
    ("environment.kwargs", {"lag": 3}, r"\$\.environment\.name: must be eitbench-Pipe2D-v0-\w{8}, as id and"),
    ("environment.kwargs", {"scenario": 10_000 * "x"}, r"\$\.environment\.kwargs: must have 10000 characters at most"),
    ("runs.0.commit", ..., r'\$\.runs\[0\]: "commit" is a required property'),
    ("episodes.0.scores.error", 0.05, r"\$\.episodes\[0\]\.scores\.error: must be the mean of step_errors"),
    ("episodes.2.message", ..., r'\$\.episodes\[2\]: "message" is a required property'),
    ("episodes.2.scores", {"error": 0.1, "seconds_per_step": 0.1}, r"\$\.episodes\[2\]\.scores: "),
    ("episodes.1.run", 1, r"\$\.episodes\[1\]\.run: there are only 1 runs"),
    ("episodes.1.seed", "test:0", r"\$\.seeds: must be the seeds of the episodes"),
    ("seeds", ["test:0", "dev:1", "test:2"], r"\$\.seeds: must all be of the split test"),
])
def test_violations_are_named(path, value, message, tmp_path):
    """A record that breaks the format is neither written nor read; the message has the file and the field."""
    wrong = changed(path, value)
    with pytest.raises(ValueError, match=message):
        write_record(tmp_path / "new", wrong)
    assert not (tmp_path / "new").exists()
    file = tmp_path / "it.json"
    file.write_text(json.dumps(with_content_hash(wrong)))
    with pytest.raises(ValueError, match=message) as caught:
        read_records(tmp_path)
    assert str(file) in str(caught.value)


@pytest.mark.parametrize("seed", ["test:999999", "test:007", "200001", "train:100000", "99999999999"])
def test_seeds_have_one_name(seed, tmp_path):
    """Seeds outside their split, or written in another form, are rejected."""
    with pytest.raises(ValueError, match=rf"\$\.seeds: '{seed}' is not an episode seed"):
        write_record(tmp_path, record("mine", {seed: 0.1}))
    for fine in ("test:99999", "300000"):
        write_record(tmp_path, record("mine", {fine: 0.1}))


@pytest.mark.parametrize("changes", [{"dirty": True}, {"commit": None, "dirty": None}])
def test_official_records_need_a_clean_commit(changes, tmp_path):
    """Records from modified code cannot be official."""
    write_record(tmp_path, record("mine", [0.1], runs=[RUN | changes]))
    write_record(tmp_path, record("mine", [0.1], official=True))
    with pytest.raises(ValueError, match=r"\$\.official: must be false unless all runs are of a commit"):
        write_record(tmp_path, record("mine", [0.1], runs=[RUN | changes], official=True))


@pytest.mark.parametrize(("old", "new"), [("0.25", "0.24"), ("test:1", "test:7"), ("An abacus", "A computer"),
                                          ('"official": false', '"official": true')])
def test_changes_by_hand_are_caught(old, new, tmp_path):
    """A better number, another seed, another machine: valid JSON of the format, with a wrong hash."""
    path = write_record(tmp_path, MINE)
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(ValueError, match=r"mine--\w+\.json was changed since it was written"):
        read_records(tmp_path)
    path.write_text(json.dumps(json.loads(text)), encoding="utf-8")    # layout is arbitrary
    assert read_records(tmp_path) == [MINE]
    path.rename(tmp_path / "yours.json")        # a record cannot replace another, or exist twice
    with pytest.raises(ValueError, match=f"must have the name {path.name}"):
        read_records(tmp_path)


def test_other_versions_of_an_environment_are_set_aside(tmp_path):
    """A record of an unregistered id is skipped with a warning; the others are read."""
    old = record("mine", [0.1], id="eitbench/Pipe2D-v99")
    path = write_record(tmp_path, old)
    write_record(tmp_path, MINE)
    with pytest.warns(UserWarning, match=r"unknown environment eitbench/Pipe2D-v99") as caught:
        assert read_records(tmp_path) == [MINE]
    assert str(path) in str(caught[0].message) and len(caught) == 1


def test_only_the_highest_version_of_a_built_in_method_is_current():
    """Environments and splits are independent; versions are ordered by number, not by text or commit."""
    v2, v10 = (record("a", [0.1], version=version, finished=when) for version, when in (
        ("v2", "2025-01-02"), ("v10", "2025-01-01")))
    tank = record("a", [0.1], id="eitbench/RotatingTank2D-v0", version="v1")
    dev = record("a", {"dev:0": 0.1}, version="v1")
    other = record("b", [0.1], version="v1", runs=[RUN | {"source": sha("other")}])
    assert split_outdated([v2, tank, v10, dev, other]) == ([tank, v10, dev, other], [v2])
    assert split_outdated([]) == ([], [])
    both = [record("mine", [0.1], version=version, finished=f"2025-01-0{version}") for version in "12"]
    assert split_outdated(both) == (both, [])                         # digits of a sha256 have no order


def test_the_schema_agrees_with_the_code():
    schema = json.loads((bundled_path("leaderboards") / "schema.json").read_text(encoding="utf-8"))
    assert jsonschema_rs.meta.is_valid(schema)
    assert schema["$schema"].endswith("2020-12/schema")
    assert tuple(schema["properties"]["board"]["enum"]) == ALL_SUBTRACKS
    assert set(schema["required"]) == set(schema["properties"]) == set(MINE)
    fields = schema["$defs"]["episode"]["properties"]
    assert set(episode("test:0", 0.1)) | {"message", "where", "actions"} == set(fields)


PIPE, LATER, LONG = "eitbench/Pipe2D-v0", "eitbench/Pipe2DFixedLag-v0", "eitbench/Pipe2DSmoothing-v0"
TOO_LONG = entry(PIPE).world.n_steps - 1


@pytest.mark.parametrize(("id", "kwargs", "board"), [
    (PIPE, {}, "filter"), (LATER, {}, "fixed-lag"), (PIPE, {"lag": TOO_LONG}, "smoothing"),
    (LONG, {"lag": 0}, "filter"), (LONG, {"lag": None}, "smoothing"), (PIPE, {"lag": "all"}, "smoothing"),
    (PIPE, {"lag": 2, "world": {"schedule": {"scored_steps": 9}}}, "fixed-lag"),
    ("eitbench/Pipe2DInjection-v0", {"gate": 3.0}, "injection")])
def test_the_environment_determines_the_subtrack(id, kwargs, board, tmp_path):
    assert subtrack_of_id(id, kwargs) == board
    environment = {"id": id, "name": environment_name(id, kwargs), "kwargs": kwargs}
    for other in ALL_SUBTRACKS:
        made = record("mine", [0.1], board=other, environment=environment)
        if other == board:
            assert read_record(write_record(tmp_path, made)) == made
        else:
            with pytest.raises(ValueError, match=rf"\$\.board: must be {board}, as the environment"):
                write_record(tmp_path, made)


@pytest.mark.parametrize(("kwargs", "message"), [
    ({"scenario": 5}, "argument of .*got 'scenario'"), ({"world": [1]}, "world"),
    ({"assume": "all"}, "assume must be a dict"), ({"lag": -1}, "lag must be"), ({"lag": {}}, "lag must be")])
def test_unknown_arguments_are_rejected(kwargs, message, tmp_path):
    environment = {"id": PIPE, "name": environment_name(PIPE, kwargs), "kwargs": kwargs}
    with pytest.raises(ValueError, match=rf"\$\.environment\.kwargs: .*{message}"):
        write_record(tmp_path, record("mine", [0.1], environment=environment))


@pytest.mark.parametrize("text", ["1e999", "NaN", "9" * 400, '"\\ud800"',
                                  "[" * MAX_RECORD_DEPTH + "]" * MAX_RECORD_DEPTH, "[" * 50_000 + "]" * 50_000])
@pytest.mark.parametrize("place", ['"parameters": {"a": 7}', '"seconds": 7', '"error": 7'])
def test_values_that_json_lacks_are_reported_with_the_file(text, place, tmp_path):
    """Numbers that are not finite, half a character, and lists that are nested too deeply are rejected everywhere."""
    mine = record("mine", [7], parameters={"a": 7}, episodes=[episode("test:0", 7) | {"seconds": 7}])
    content = json.dumps(mine)
    assert place in content
    (tmp_path / "it.json").write_text(content.replace(place, place.replace("7", text), 1))
    with pytest.raises(ValueError, match=r"record .*it\.json (cannot be read|is not valid)"):
        read_record(tmp_path / "it.json")


def test_large_and_special_files_are_not_opened(tmp_path):
    """Reading a pipe would never end."""
    path = tmp_path / "it.json"
    makers = [path.touch, path.mkdir] + ([lambda: os.mkfifo(path)] if hasattr(os, "mkfifo") else [])
    for make in makers:
        make()
        if path.is_file():
            os.truncate(path, MAX_BYTES + 1)
        with pytest.raises(ValueError, match=r"it\.json cannot be read: it must be a file of at most 8 MiB"):
            read_record(path)
        path.rmdir() if path.is_dir() else path.unlink()


def test_versions_and_splits_have_separate_files(tmp_path):
    """Other versions of the method, or other seeds, do not replace a record; runs with other library versions do."""
    other_code = RUN | {"source": sha("newer")}
    for each in (MINE, record("mine", [0.1], version="2"), record("mine", [0.1], version="v1"),
                 record("mine", {"dev:0": 0.1}), record("mine", [0.3], runs=[other_code])):
        write_record(tmp_path, each)
    assert len(read_records(tmp_path)) == 4
    assert MINE not in read_records(tmp_path)
