"""Submissions: test episodes are run, and records written, including failures, by the command `eitbench submit`."""

import re
from pathlib import Path

import pytest
from eitbench.bench import methods, run
from eitbench.bench.records import read_record, read_records, split_outdated, write_record
from eitbench.bench.store import EpisodeStore, machine, provenance
from eitbench.bench.submit import submit
from eitbench.data.seeds import parse_seeds
from eitbench.report import compare

from commands import eitbench
from short import shorten
from tiny import FILTER, SMOOTHING, count, counting, git_says, write_baseline

INJECTION = "eitbench/Pipe2DInjection-v0"
TEST = parse_seeds("test:0-1")


def submitted(method, seeds, results, **how):
    """Return the record in the folder ``to``, submitted with results in this folder."""
    (path,) = submit(method, [FILTER.id], seeds, EpisodeStore(Path(results)), Path("to"), **how)
    return read_record(path)


@pytest.fixture(autouse=True)
def tiny_world(monkeypatch, tmp_path):
    """Use tiny worlds for the registered ids, an empty folder, and a clean commit."""
    git_says(monkeypatch, "c0ffee")
    shorten(monkeypatch, FILTER.id, SMOOTHING.id, INJECTION)
    monkeypatch.chdir(tmp_path)


def test_a_submission_is_a_record_per_environment(tmp_path):
    """Records are self-reported without the flag; the same command runs nothing."""
    log = tmp_path / "log"
    mine, store, to = write_baseline(tmp_path, init=counting(log)), EpisodeStore(tmp_path / "results"), tmp_path / "to"
    paths = list(submit(mine, [FILTER.id, SMOOTHING.id], TEST, store, to, isolate="none", command="eitbench submit"))
    first, second = (read_record(path) for path in paths)
    assert (first["board"], second["board"]) == ("filter", "smoothing") and count(log) == 4
    assert first["seeds"] == ["test:0", "test:1"] and not first["official"] and first["split"] == "test"
    assert first["runs"][0]["command"] == "eitbench submit"
    assert first["runs"][0]["machine"]["matmul_seconds"] == machine()["matmul_seconds"] > 0
    assert sorted(path.name for path in to.iterdir()) == sorted(path.name for path in paths)
    again = list(submit(mine, [FILTER.id], TEST, store, to, official=True, isolate="process"))
    assert again == paths[:1] and count(log) == 4 and read_record(again[0])["official"]
    assert [record["official"] for record in read_records(to)] == [True, False]


def test_all_built_in_methods_by_one_command(tmp_path, monkeypatch):
    """All compatible methods run, by environment: finished environments have records after an interruption."""
    monkeypatch.setattr(run, "builtin_methods", lambda track: ["persistence", "inflow_smoother"])
    made = submit(None, [FILTER.id, SMOOTHING.id], TEST[:1], EpisodeStore(tmp_path / "r"), tmp_path / "to")
    assert "--persistence--" in next(made).name
    assert [path.name.split("--")[1] for path in (tmp_path / "to").iterdir()] == ["persistence"]
    assert sorted(path.name.split("--")[:2] for path in made) == [
        [SMOOTHING.id.replace("/", "-"), name] for name in ("inflow_smoother", "persistence")]


def test_policies_by_command(tmp_path):
    """`run` prints scores and resumes; its episodes are in the table and on the page of `leaderboard`."""
    command = ("run", "--env", INJECTION, "--policy", "adjacent", "--policy", "random_pair", "--policy",
               "clairvoyant", "--seeds", "test:0", "--estimator", "reduced", "-j", "1")
    code, said, _ = eitbench(*command)
    assert code == 0 and "| clairvoyant (privileged) |" in said and "adaptivity gap" in said
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("results/episodes/*/*/*.json")}
    code, again, complaint = eitbench(*command)
    assert len(before) == 3 and again.endswith(said) and "3 of 3 episodes are already stored" in again + complaint
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert eitbench("run", "--env", FILTER.id, "--baseline", "homogeneous", "--seeds", "test:0", "-j", "1")[0] == 0
    code, said, _ = eitbench("leaderboard")
    assert code == 0 and "estimator=reduced" in said and "homogeneous" in said
    assert "Pipe2DInjection" in (tmp_path / "results" / "index.html").read_text(encoding="utf-8")


def test_episodes_in_records_are_not_rerun(tmp_path):
    """The table has all episodes; only episodes without a record are run."""
    method, short = ("--env", FILTER.id, "--baseline", "homogeneous"), ("-j", "1", "-o")
    assert eitbench("submit", *method, "--seeds", "test:0", *short, "first")[0] == 0
    code, said, _ = eitbench("run", *method, "--seeds", "test:0-1", "--records", "leaderboards/results", *short, "rest")
    assert code == 0 and [path.name for path in tmp_path.glob("rest/episodes/*/*/*.json")] == ["test-1.json"]
    (score,) = re.findall(r"\| homogeneous[^|]+\| ([^|]+) \|", said)
    assert f"{score} |" in eitbench("run", *method, "--seeds", "test:0-1", *short, "all")[1]
    code, _, complaint = eitbench("run", *method, "--records", "nowhere", *short, "none")
    assert code == 2 and "--records must be a folder, got nowhere" in complaint


@pytest.mark.parametrize(("environments", "seeds", "message"), [
    ([FILTER.id], "dev:0", "seeds must be of the split test, got dev"),
    ([], "test:0", "env must name at least one environment"),
    ([FILTER.id, SMOOTHING.id], "test:0", f"baseline kalman_filter suits none of the environments {SMOOTHING.id}"),
])
def test_invalid_submissions(environments, seeds, message, tmp_path):
    """The call raises the error before the iteration; nothing is run or written."""
    with pytest.raises(ValueError, match=message):
        submit("kalman_filter", environments, parse_seeds(seeds), EpisodeStore(tmp_path / "r"), tmp_path / "to")
    assert not (tmp_path / "r").exists() and not (tmp_path / "to").exists()


def test_official_needs_a_clean_commit(tmp_path, monkeypatch):
    """The error is raised before any episode is run; after a commit the same call succeeds."""
    for commit, message in (("c0ffee", "and changes to c0ffee"), (None, "outside a checkout")):
        with monkeypatch.context() as patch, pytest.raises(ValueError, match=f"official must be False .*{message}"):
            git_says(patch, commit, "M README.md")
            submitted("homogeneous", TEST[:1], "r", official=True)
        assert not list(tmp_path.iterdir())
    provenance.cache_clear()
    assert submitted("homogeneous", TEST[:1], "r", official=True)["official"]


def test_official_and_longer_records_are_not_replaced(tmp_path, monkeypatch):
    """Unofficial and shorter records are rejected; a newer version has a separate record."""
    to = tmp_path / "to"
    first = submitted("homogeneous", TEST, "a")
    with pytest.raises(ValueError, match=r"to must not hold a record with other episodes; .*homogeneous.* lose its "
                                         "episodes test:1$"):
        submitted("homogeneous", TEST[:1], "b", official=True)
    assert read_records(to) == [first]
    first = submitted("homogeneous", TEST, "a", official=True)
    with pytest.raises(ValueError, match=r"to must not hold an official record; .* lose its official status$"):
        submitted("homogeneous", TEST, "c")
    assert read_records(to) == [first] and not (tmp_path / "c").exists()               # the error precedes all runs
    path = write_record(to, first | {"runs": [run | {"commit": "decaf"} for run in first["runs"]]})
    with pytest.raises(ValueError, match="would lose its official status"):
        submitted("homogeneous", TEST[:1], "b")
    with monkeypatch.context() as patch:
        patch.setattr(methods, "golden_version", lambda name: 2)
        assert submitted("homogeneous", TEST[:1], "b")["seeds"] == ["test:0"]
    newer = read_record(path.with_name(path.name.replace("v1", "v2")))
    assert split_outdated(read_records(to)) == ([read_record(path), newer], [])  # an official record stays current


def test_a_record_is_extended(tmp_path):
    """Episodes run in another folder are added; episodes of the record are neither rerun nor lost."""
    log = tmp_path / "log"
    mine = write_baseline(tmp_path, init=counting(log))
    first = submitted(mine, parse_seeds("test:10"), "a", isolate="none", command="first")
    both, again = (submitted(mine, parse_seeds("test:9-10"), folder, isolate="none", command="both")
                   for folder in "bc")
    assert count(log) == 2 and both["seeds"] == ["test:9", "test:10"] and not both["official"]
    assert [made["command"] for made in both["runs"]] == ["both", "first"]
    assert both["episodes"][1] == first["episodes"][0] | {"run": 1}
    assert again == both


def test_invalid_results_are_not_submitted(tmp_path, monkeypatch):
    """The message has the method, and nothing is written."""
    monkeypatch.setattr(run, "compute_scores", lambda *asked, compute=run.compute_scores: (
        compute(*asked) | {"seconds_per_step": -1.0}))
    with pytest.warns(UserWarning, match=r"homogeneous/test-0\.json is left out: it is not valid: .*seconds_per_step"):
        code, _, complaint = eitbench("submit", "--baseline", "homogeneous", "--env", FILTER.id, "--seeds", "test:0",
                                      "-j", "1")
    assert code == 2 and "holds no valid result of homogeneous" in complaint
    assert not (tmp_path / "leaderboards").exists()


def test_from_a_file_to_the_leaderboards_by_command(tmp_path, monkeypatch):
    """The commands submit, leaderboard and compare work as README describes."""
    monkeypatch.setattr(compare, "BUNDLED_RECORDS", tmp_path)      # all records take seconds
    write_baseline(tmp_path)
    common = ("--env", FILTER.id, "--seeds", "test:0-6", "-j", "1")
    code, said, complaint = eitbench("submit", "--baseline", "mine.py", *common)
    assert "warning: ẽ_c is larger than for the homogeneous estimate in test:" in complaint
    assert code == 0 and re.fullmatch(
        r"wrote leaderboards/results/eitbench-Pipe2D-v0--mine--\w{8}\.json: 7 episodes, ẽ_c 0\.\d+ ± .*, ms/step .*\n",
        said)
    assert eitbench("submit", "--baseline", "homogeneous", *common)[0] == 0
    code, said, _ = eitbench("leaderboard", "--records", "leaderboards/results")
    assert said.splitlines() == [f"wrote leaderboards/{name}" for name in (
        "leaderboard.csv", "leaderboard.md", "site/index.html", "episodes.csv.xz")]
    assert "Mine" in (tmp_path / "leaderboards" / "site" / "methods" / "mine.html").read_text(encoding="utf-8")
    text = (tmp_path / "leaderboards" / "leaderboard.md").read_text(encoding="utf-8")
    assert re.search(r"\| +1 +\| Mine mine@\w{8} +\|.*\| self-reported \|", text)
    assert "(naive baseline)" in text

    code, said, _ = eitbench("compare", "mine", "homogeneous")
    assert code == 0 and said.startswith("A: mine\nB: homogeneous\n") and "| Pipe2D-v0 " in said
    record = next(tmp_path.glob("leaderboards/results/*mine*"))
    assert eitbench("compare", str(record), "homogeneous")[1].splitlines()[:3] == said.splitlines()[:3]

    record.write_text(record.read_text().replace('"official": false', '"official": true'))
    code, _, complaint = eitbench("leaderboard", "--records", "leaderboards/results")
    assert code == 1 and "was changed since it was written" in complaint
