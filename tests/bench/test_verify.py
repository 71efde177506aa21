"""Verification: valid records agree; changed numbers, other files, caches and memorised episodes are detected."""

import hashlib
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from eitbench.bench import held_out, isolation, methods, run
from eitbench.bench import verify as verification
from eitbench.bench.held_out import held_out_seeds, p_value, read_secret
from eitbench.bench.records import read_record, write_record
from eitbench.bench.run import Job, run_episode
from eitbench.bench.verify import score_differences
from eitbench.data.cache import CACHE_VARIABLE, cache_folder, folder
from eitbench.data.episodes import simulate
from eitbench.data.seeds import SPLITS, parse_seeds

from commands import eitbench
from short import TINY, shorten
from tiny import FILTER, SMOOTHING, confined, git_says, write_baseline, write_policy

INJECTION = "eitbench/Pipe2DInjection-v0"
CURRENTS = "eitbench/Pipe2DInjectionCurrents-v0"
SECRET = bytes(range(32))
AGREE = "1 of 1 records agree"
HERE = ("-j", 1, "--isolate", "process")
REDUCED = ("--seeds", "dev:0", "--estimator", "reduced", "-j", 1)


@pytest.fixture(autouse=True)
def tiny_world(monkeypatch, tmp_path):
    """Use tiny worlds for the registered ids, and an empty folder."""
    git_says(monkeypatch)
    shorten(monkeypatch, FILTER.id, SMOOTHING.id, INJECTION, CURRENTS)
    monkeypatch.setattr(held_out, "COMMITMENT", tmp_path / "held_out.json")
    monkeypatch.chdir(tmp_path)
    yield
    isolation.close()


def submitted(method, seeds="test:0", env=FILTER.id):
    """Return the path of a record made as README describes."""
    code, said, complaint = eitbench("submit", "--baseline", method, "--env", env, "-j", 1, "--isolate", "none",
                                     "--to", "board/results", "--seeds", seeds)
    assert code == 0, complaint
    return Path(said.split(":")[0].removeprefix("wrote "))


def changed(path, change, to="forged/results"):
    """Write the record with changed content and a matching digest."""
    record = json.loads(path.read_text())
    change(record)
    return write_record(Path(to), record)


def better(record, factor=0.9, count=None):
    for episode in record["episodes"][:count]:
        episode["step_errors"] = [factor * error for error in episode["step_errors"]]
        episode["scores"]["error"] = float(np.mean(episode["step_errors"]))


def official(record):
    record["official"] = True
    for entry in record["runs"]:
        entry |= {"commit": "0" * 40, "dirty": False}


def write_mine(folder):
    return write_baseline(folder, parameters="{'pair': (1, 2)}",
                          update="return Estimate(self.level + voltages.sum(), self.level, voltages, np.eye(4))")


@pytest.fixture(scope="module")
def submission(tmp_path_factory):
    """Return a folder with the record of one episode of that file."""
    folder = tmp_path_factory.mktemp("submission")
    with pytest.MonkeyPatch.context() as patch:
        git_says(patch)
        shorten(patch, FILTER.id)
        patch.chdir(folder)
        submitted(write_mine(folder))
    isolation.close()
    return folder / "board"


@pytest.fixture
def own(submission, tmp_path):
    shutil.copytree(submission, tmp_path / "board")
    (path,) = Path("board/results").glob("*.json")
    return path


def test_a_valid_record_agrees():
    """Episodes are simulated again and chosen by the seed; the output is a Markdown table, also of stored results."""
    path = submitted("homogeneous", "test:0-3")
    command = ("verify", path, "--episodes", 2, "--seed", 5, "-j", 1, "--out", "again")
    code, said, complaint = eitbench(*command)
    assert code == 0 and AGREE in said and "--seed 5" in said, complaint
    assert len(re.findall(r"\| test:\d +\| none +\|.*\| none +\|", said)) == 2
    assert eitbench(*command)[1] == f"2 of 2 episodes are already stored\n{said}"
    table = verification.verify([path], Path("again"), episodes=2, seed=6)
    assert list(table["episode"]) != re.findall(r"test:\d", said)


def test_privileged_policies_and_failures_are_verified(tmp_path):
    """Built-in methods are known by name, and run with the arguments of the record; a failure
    agrees with a failure. Records that cannot be verified lead to exit status 1."""
    assert eitbench("run", "--env", INJECTION, "--policy", "clairvoyant", *REDUCED)[0] == 0
    (path,) = tmp_path.glob("results/records/*--clairvoyant--*")
    code, said, complaint = eitbench("verify", path, "-j", 1)
    assert code == 0 and "dev:0" in said, complaint
    fails = write_baseline(tmp_path, "fails", update="if voltages[0] != 0.0: raise ValueError('dry')")
    path = submitted(fails)
    assert eitbench("verify", path, "--method", fails, *HERE)[0] == 0
    code, _, complaint = eitbench("verify", path, "-j", 1)
    assert code == 1 and "fails is not a built-in method" in complaint and "--method" in complaint
    (tmp_path / "record.json").write_text("{}")
    code, _, complaint = eitbench("verify", "record.json")
    assert code == 1 and "not verified: record.json" in complaint


def failed(record):
    episode = record["episodes"][0]
    del episode["scores"], episode["step_errors"]
    episode |= {"status": "failed", "message": "RuntimeError: oh", "where": "mine.py:1"}


def test_changed_records_are_found(own):
    """The digest matches the changed content. The file of each record is found by its sha256 in the
    folder methods next to it, as in a pull request."""
    changes = {"better": better, "failed": failed, "title": lambda record: record.update(title="Theirs"),
               "almost": lambda record: better(record, 1.0 + 1e-4)}
    paths = {name: changed(own, change, f"{name}/results") for name, change in changes.items()}
    for name in changes:
        write_mine(Path(name, "methods", "somebody"))
    code, _, complaint = eitbench("verify", *paths.values(), *HERE, "--out", "again")
    assert code == 1 and complaint.count("differs: ") == 4
    for message in (r"test:0: \w+ differs by 0\.1 ", "status is ok", r"differs by 0\.0001 ",
                    "title is 'Mine', but 'Theirs' in the record"):
        assert re.search(message, complaint), message
    assert eitbench("verify", paths["almost"], *HERE, "--out", "again", "--tolerance", "1e-3")[0] == 0


def test_differences_of_numbers():
    """All recorded scores and step errors are compared, except times; a record may lack a newer score.
    Rounding may move a few nodes across the end of an interval."""
    scores = {"error": 0.15, "nis": 1.2, "crps": 0.4, "coverage_90": 0.9, "seconds_per_step": 0.1}
    now = {"status": "ok", "step_errors": [0.2, 0.1], "scores": scores}
    same = now | {"scores": scores | {"coverage_90": 0.90005}}
    assert set(score_differences(now, same)) == {"error", "nis", "crps", "coverage_90", "step_errors"}
    assert not any(score_differences(now, same).values())
    for said, name, expected in [
            ({"scores": {"nis": 1.3}}, "nis", 0.1 / 1.3),
            ({"scores": {"coverage_90": 0.899}}, "coverage_90", 0.001 / 0.9),
            ({"scores": {"crps": None}}, "crps", np.inf),
            ({"step_errors": [0.1, 0.2]}, "step_errors", 0.5)]:
        wrong = now | said | {"scores": now["scores"] | said.get("scores", {})}
        assert score_differences(wrong, now)[name] == pytest.approx(expected)
    older = now | {"scores": {"error": 0.15, "seconds_per_step": 9.0}}
    assert set(score_differences(older, now)) == {"error", "step_errors"}
    assert not any(score_differences(older, now).values())
    assert score_differences(now, older)["nis"] == np.inf


def test_another_file_does_not_run(own, tmp_path):
    """Its scores would not verify the record; a link to a built-in file is rejected too."""
    another = write_baseline(tmp_path / "another", update=f"open({str(tmp_path / 'ran')!r}, 'w')")
    code, _, complaint = eitbench("verify", own, "--method", another, *HERE)
    assert code == 1 and "the sha256 of mine.py is" in complaint and not (tmp_path / "ran").exists()
    link = tmp_path / "link" / "mine.py"
    link.parent.mkdir()
    link.symlink_to(methods.find_method("homogeneous", "estimation"))
    with pytest.raises(ValueError, match="must be the method of the record, mine, got another built-in"):
        verification.job_for_record(read_record(own), str(link))


def test_only_numbers_of_built_in_methods_are_compared(monkeypatch):
    """A built-in method's record may differ in texts; a record of an older version has a note, a newer one is wrong."""
    path = submitted("homogeneous")

    def reworded(record):
        record |= {"title": "Another title", "method_sha256": "0" * 64, "parameters": {"words": 1}}

    assert eitbench("verify", changed(path, reworded), "-j", 1)[0] == 0
    code, _, complaint = eitbench("verify", changed(path, lambda record: record.update(role=None)), "-j", 1)
    assert code == 1 and "but None in the record" in complaint
    newer = changed(path, lambda record: record.update(version="v9"))
    code, _, complaint = eitbench("verify", newer, "-j", 1)
    assert code == 1 and "the record is of v9, but homogeneous is v1" in complaint
    monkeypatch.setattr(methods, "version_of", lambda path, sha256: "v2")
    code, said, _ = eitbench("verify", path, "-j", 1)
    assert code == 0 and "the record is of v1, and homogeneous is now v2" in said


def test_the_cache_is_not_used(tmp_path, monkeypatch):
    """A score from a cache in which test:0 is another, easier episode does not agree."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    world, seed = TINY, parse_seeds("test:0")[0]
    honest = simulate(world, seed, progress=False)
    flat = honest._replace(concentration=np.full_like(honest.concentration, world.expected_concentration))
    shutil.rmtree(folder(world))
    with monkeypatch.context() as patch:
        patch.setattr("eitbench.data.episodes.simulate_batch", lambda *_: iter([flat]))
        path = submitted("homogeneous")
    assert list(folder(world).glob("*.truth.npy"))
    assert eitbench("verify", path, "-j", 1)[0] == 1
    assert cache_folder() == tmp_path / "cache"


def test_all_official_records_are_verified_and_a_false_one_is_reported(monkeypatch):
    """A repeated command resumes. Damaged files are reported before any episode is run."""
    for env in (FILTER.id, SMOOTHING.id):
        changed(submitted("homogeneous", "test:0-1", env), official)
    changed(submitted("persistence", "test:0-1"), lambda record: None)               # self-reported: not verified
    command = ("verify", "--all", "--records", "forged/results", "--out", "again", "--episodes", 2, "-j", 1)
    code, said, complaint = eitbench(*command)
    assert code == 0 and "2 of 2 records agree" in said and "persistence" not in said, complaint
    false = changed(submitted("persistence", "test:0-1"), lambda record: (official(record), better(record, 0.5)))
    ran = []
    monkeypatch.setattr(run, "run_episode", lambda job: ran.append(job.method) or run_episode(job))
    code, said, complaint = eitbench(*command)
    assert code == 1 and complaint.count("differs: ") == 2 and ran == ["persistence"] * 2
    assert false.name in complaint and "by 0.5" in complaint and "homogeneous" not in complaint
    (Path("forged/results") / "damaged.json").write_text("{")
    code, _, complaint = eitbench(*command)
    assert code == 2 and "damaged.json" in complaint


def test_the_first_records_of_a_board_are_chosen(own):
    """Records are chosen by mean error, including self-reported ones, without naive baselines."""
    naive = submitted("homogeneous")
    second = changed(own, lambda record: (better(record, 1.1), record.update(
        version="1" * 8, method_sha256="1" * 64)), own.parent)
    assert verification.select_records(own.parent, top=3) == [own, second] and naive.exists()
    assert verification.select_records(own.parent, [FILTER.id], top=1) == [own]
    with pytest.raises(ValueError, match=f"such records of {INJECTION}"):
        verification.select_records(own.parent, [INJECTION], top=1)


@pytest.mark.parametrize("env", [INJECTION, CURRENTS])
def test_recorded_actions_are_replayed_without_the_policy(env, monkeypatch):
    """For pairs and currents, other actions give other scores, and a missing action is reported."""
    currents = "x = self.random.uniform(-1.0, 1.0, self.space.shape).astype('f4'); return x - x.mean()"
    policy = "random_pair" if env == INJECTION else write_policy(Path(), currents)
    assert eitbench("run", "--env", env, "--policy", policy, "--isolate", "none", *REDUCED)[0] == 0
    (path,) = Path("results/records").iterdir()
    record = read_record(path)
    assert len(record["episodes"][0]["actions"]) > 1

    def refuse(*_):
        raise AssertionError("the policy's code ran")

    monkeypatch.setattr(run, "run_episode", refuse)
    code, said, complaint = eitbench("verify", path, "--replay", "-j", 1)
    assert code == 0 and "| replay" in said, complaint

    def other_first(record):
        actions = record["episodes"][0]["actions"]
        actions[0], actions[1] = actions[1], actions[0]

    changes = {r"\w+ differs by": other_first,
               "has no recorded actions": lambda record: record["episodes"][0].pop("actions"),
               "must have one entry": lambda record: record["episodes"][0]["actions"].pop()}
    paths = [changed(path, change, f"{k}/results") for k, change in enumerate(changes.values())]
    code, _, complaint = eitbench("verify", *paths, "--replay", "-j", 1)
    assert code == 1 and all(re.search(message, complaint) for message in changes), complaint


def write_secret(secret=SECRET, mode=0o600):
    path = Path("secret").absolute()
    path.write_text(secret.hex())
    path.chmod(mode)
    Path("held_out.json").write_text(json.dumps({"salt_sha256": hashlib.sha256(SECRET).hexdigest()}))
    return path


def test_held_out_seeds_are_the_formula():
    """The seeds are SHA-256 of secret and number, outside the public splits; the commitment is a hash."""
    seeds = held_out_seeds(SECRET, 50)
    assert seeds[1] == int(hashlib.sha256(SECRET + bytes(7) + b"\1").hexdigest(), 16) % 2**63
    assert len(set(seeds)) == 50 and max(split.stop for split in SPLITS.values()) <= min(seeds) < max(seeds) < 2**63
    published = Path(held_out.__file__).parents[2] / "leaderboards" / "held_out.json"
    assert re.fullmatch("[0-9a-f]{64}", json.loads(published.read_text())["salt_sha256"])


def test_a_secret_is_private_and_committed():
    assert read_secret(write_secret()) == SECRET
    for secret, mode, message in ((bytes(32), 0o600, "commits to"), (SECRET, 0o640, "by its owner only"),
                                  (b"short", 0o600, "must have 32 bytes, got 5")):
        with pytest.raises(ValueError, match=message):
            read_secret(write_secret(secret, mode))
    with pytest.raises(ValueError, match="must be a file of hexadecimal digits"):
        read_secret(Path("nothing").absolute())


@pytest.mark.parametrize(("gain", "low", "high"), [(0.0, 0.02, 0.08), (0.3, 0.6, 1.0), (-0.3, 0.0, 0.01)])
def test_error_rates_of_the_held_out_test(gain, low, high):
    """Rejection rates of 300 records of ten episodes, with 30 held-out ones: 5 % of valid records, most records that
    are 30 % better on public episodes, and none that are worse."""
    random = np.random.default_rng(7)
    rejected = [p_value(random.normal(np.log1p(-gain), 0.3, 10), random.normal(0.0, 0.3, 30), 399) < 0.05
                for _ in range(300)]
    assert low <= np.mean(rejected) <= high


@confined
def test_held_out_episodes_detect_memorised_ones(tmp_path, monkeypatch):
    """Seeds and secret are neither printed nor passed to the worker; third-party files need bubblewrap."""
    mine = write_mine(tmp_path)
    public = submitted(mine, "test:0-4")
    claim = ("--episodes", 0, "--held-out", 4, "--secret", write_secret(), "--method", mine, "-j", 1)
    passed = []
    encode = isolation.encode_message
    monkeypatch.setattr(isolation, "encode_message", lambda *message: passed.append(encode(*message)) or passed[-1])
    code, said, complaint = eitbench("verify", public, *claim)
    assert code == 0 and hashlib.sha256(SECRET).hexdigest() in said and re.search(r"\(5\).*\(4\)", said), complaint
    assert sum(b'"update"' in message for message in passed) == 4 * 5
    for seed in held_out_seeds(SECRET, 4):
        spellings = (str(seed).encode(), seed.to_bytes(8, "little"), seed.to_bytes(8, "big"))
        assert not any(each in message for each in spellings for message in passed) and str(seed) not in said
    assert SECRET.hex() not in said
    code, _, complaint = eitbench("verify", changed(public, lambda record: better(record, 0.1)), *claim)
    assert code == 1 and re.search(r"0\.\d+ in the record, \S+ on held-out episodes \(p = 0\.0", complaint)
    code, _, complaint = eitbench("verify", public, *claim, "--isolate", "process")
    assert code == 1 and "must run under bubblewrap on held-out episodes" in complaint


def test_records_of_the_baseline_are_not_used():
    """The naive baseline is run on both kinds of episodes: compared with itself it is never better."""
    path = submitted("homogeneous", "test:0-5")
    row, problems = held_out.verify_held_out(read_record(path), Job(FILTER._replace(kwargs="{}"), "homogeneous", 0),
                                             SECRET, 4)
    assert not problems and row["recorded"] == "1 (6)" and row["held-out"] == "1 (4)" and float(row["p"]) == 1.0
    with pytest.raises(ValueError, match="must be more for a test, got 1 and 6"):
        held_out.verify_held_out(read_record(path), Job(FILTER._replace(kwargs="{}"), "homogeneous", 0), SECRET, 1)
