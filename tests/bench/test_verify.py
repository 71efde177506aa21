"""Verifying: honest records pass, and whoever changed a number, a file or the cache is found out."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from eitbench.bench import held_out, methods, run, salts
from eitbench.bench import store as store_module
from eitbench.bench import verify as verification
from eitbench.bench.records import read_record, write_record
from eitbench.bench.sandbox import guests, host, wire
from eitbench.bench.sandbox.wall import landlock_version
from eitbench.bench.tracks import named
from eitbench.data.cache import CACHE_VARIABLE, cache_folder, folder
from eitbench.data.episodes import simulate
from eitbench.data.seasons import drawn_seeds
from eitbench.data.seeds import SPLITS, parse_seeds
from eitbench.worlds.catalogue import PIPE_2D

from commands import eitbench
from short import PIPE, merged, shorten
from tiny import FILTER, SCENARIO, git_says, write_baseline

INJECTION = "eitbench/Pipe2DInjection-v0"
SALT = bytes(range(32))
walled = pytest.mark.skipif(not landlock_version(), reason="this kernel has no Landlock")


@pytest.fixture(autouse=True)
def tiny_world(monkeypatch, tmp_path):
    """The registered environments play tiny worlds, in an empty folder."""
    git_says(monkeypatch)
    shorten(monkeypatch, {FILTER.id: SCENARIO, INJECTION: PIPE})
    monkeypatch.setattr(salts, "PUBLISHED", tmp_path / "leaderboards" / "held_out.json")
    monkeypatch.chdir(tmp_path)
    store_module.provenance.cache_clear()
    yield
    guests.close()
    store_module.provenance.cache_clear()


def submitted(method, *more, env=FILTER.id, kind="--baseline"):
    """The path of a record that is made as README says."""
    code, said, complaint = eitbench("submit", kind, method, "--env", env, "-j", 1, "--to", "records", *more)
    assert code == 0, complaint
    return Path(said.split(":")[0].removeprefix("wrote "))


def forged(path, change, to="forged"):
    """The record with a changed content and the digest that goes with it."""
    record = json.loads(path.read_text())
    change(record)
    return write_record(Path(to), record)


def better(record):
    for episode in record["episodes"]:
        episode["step_errors"] = [0.9 * error for error in episode["step_errors"]]
        episode["scores"]["error"] = float(np.mean(episode["step_errors"]))


@pytest.fixture
def mine(tmp_path):
    return write_baseline(tmp_path, parameters="{'pair': (1, 2)}",
                          update="return Estimate(self.level + voltages.sum(), self.level, voltages, np.eye(4))")


def test_an_honest_record_is_verified(mine):
    """In a guest, from episodes that are simulated again; which of them, the seed says."""
    path = submitted(mine, "--seeds", "test:0-3")
    code, said, complaint = eitbench("verify", path, "--baseline", mine, "--episodes", 2, "--seed", 5)
    assert (code, complaint) == (0, "") and "as it says" in said and "--seed 5" in said
    drawn = re.findall(r"test:\d", said)
    assert len(drawn) == 2 and said.count("| none") == 2
    assert eitbench("verify", path, "--baseline", mine, "--episodes", 2, "--seed", 5)[1] == said
    seeds = {tuple(re.findall(r"test:\d", verification.verify(*claim, episodes=2, seed=seed)[0]))
             for claim in [(read_record(path), verification.job_of(read_record(path), mine))] for seed in range(4)}
    assert len(seeds) > 1
    with pytest.raises(ValueError, match="episodes must be an integer of at least 1, got 0"):
        verification.verify({}, None, episodes=0)


def test_ours_are_known_by_name(tmp_path):
    """Policies, privileged ones and failures too; arguments of one's own are those of the record."""
    for name in ("random_pair", "clairvoyant"):
        assert eitbench("policies", "--env", INJECTION, "--policy", name, "--seeds", "dev:0", "--estimator", "reduced",
                        "-j", 1)[0] == 0
        (path,) = tmp_path.glob(f"results/records/*--{name}--*")
        code, said, complaint = eitbench("verify", path)
        assert code == 0 and "dev:0" in said, complaint
    fails = write_baseline(tmp_path, "fails", update="if voltages[0] != 0.0: raise ValueError('dry')")
    path = submitted(fails, "--seeds", "test:0")
    assert eitbench("verify", path, "--baseline", fails)[0] == 0
    code, _, complaint = eitbench("verify", path)
    assert code == 1 and "fails is none of ours: its file must be given" in complaint


def test_a_record_from_before_a_score_is_verified(tmp_path):
    """Without what the filter claims it is compared by the rest; with it, a wrong one is found."""
    claims = ("nis", "crps", "coverage_50", "coverage_90", "spread_ratio")
    assert eitbench("policies", "--env", INJECTION, "--policy", "random_pair", "--seeds", "dev:0",
                    "--estimator", "reduced", "-j", 1)[0] == 0
    (path,) = tmp_path.glob("results/records/*--random_pair--*")
    now = read_record(path)["episodes"][0]["scores"]
    assert all(now[name] is not None for name in claims)

    def older(record):
        for name in claims:
            del record["episodes"][0]["scores"][name]

    def wrong(record):
        record["episodes"][0]["scores"]["nis"] *= 1.01

    code, said, complaint = eitbench("verify", forged(path, older, "older"))
    assert code == 0 and "as it says" in said, complaint
    code, _, complaint = eitbench("verify", forged(path, wrong, "wrong"))
    assert code == 1 and "nis is" in complaint


@walled
def test_a_stranger_s_policy_is_submitted_and_verified(tmp_path):
    """In guests both times, by the same random numbers; the record says so."""
    mine = tmp_path / "by_lot.py"
    mine.write_text('"""Mine."""\nclass Policy:\n    def __init__(self, rules, random):\n'
                    '        self.draw = lambda: int(random.integers(rules.action_space.n))\n'
                    '    def act(self, observation):\n        return self.draw()\n')
    path = submitted(mine, "--seeds", "test:0", env=INJECTION, kind="--policy")
    record = read_record(path)
    assert record["runs"][0]["isolation"] == "landlock" and record["episodes"][0]["peak_memory"] > 50e6
    code, said, complaint = eitbench("verify", path, "--policy", mine)
    assert code == 0 and "isolation landlock" in said, complaint


def test_changed_numbers_are_found(mine, tmp_path):
    """By hand: the digest. With the digest: the episodes say otherwise, whatever was changed."""
    path = submitted(mine, "--seeds", "test:0")
    by_hand = tmp_path / "by_hand" / path.name
    by_hand.parent.mkdir()
    by_hand.write_text(path.read_text().replace('"parameters": {"pair": [1, 2]}', '"parameters": {"pair": [1, 3]}'))
    code, _, complaint = eitbench("verify", by_hand, "--baseline", mine)
    assert code == 1 and "was changed since it was written" in complaint

    def other(name, value):
        return lambda record: record["episodes"][0]["scores"].update({name: value})

    def failed(record):
        episode = record["episodes"][0]
        del episode["scores"], episode["step_errors"]
        episode |= {"status": "failed", "message": "RuntimeError: oh", "where": "mine.py:1"}

    def redistributed(record):
        steps = record["episodes"][0]["step_errors"]
        record["episodes"][0]["step_errors"] = [steps[0] + 1e-4, steps[1] - 1e-4, *steps[2:]]

    def elsewhere(record):
        given = {"world": merged(SCENARIO, {"flow": {"mean_velocity": 60.0}})}
        record["environment"].update(kwargs=given, name=named(FILTER.id, given))

    for change, message in (
            (better, r"test:0: error is 0\.\d+, the record says 0\.\d+"), (other("nis", 1.0), "test:0: nis is"),
            (other("crps", None), "test:0: crps is"), (redistributed, r"test:0: step_errors\[[01]\] is"),
            (failed, r"test:0: status is ok, the record says failed \(RuntimeError: oh\)"),
            (lambda record: record.update(title="Theirs"), "title is 'Mine', the record says 'Theirs'"),
            (elsewhere, "test:0: error is")):
        code, said, complaint = eitbench("verify", forged(path, change), "--baseline", mine)
        assert code == 1 and re.search(message, complaint) and "as it says" not in said, (message, complaint)
    slower = forged(path, other("seconds_per_step", 1e-9))
    assert eitbench("verify", slower, "--baseline", mine)[0] == 0        # a clock is no proof of anything


def test_the_tolerance_is_what_it_says(mine):
    """A relative difference of 1e-4 is none where 1e-3 is allowed."""
    path = submitted(mine, "--seeds", "test:0")

    def slightly(record):
        scores = record["episodes"][0]["scores"]
        scores["nis"] *= 1.0 + 1e-4

    other = forged(path, slightly)
    assert eitbench("verify", other, "--baseline", mine)[0] == 1
    assert eitbench("verify", other, "--baseline", mine, "--tolerance", "1e-3")[0] == 0
    assert eitbench("verify", other, "--baseline", mine, "--tolerance", "5e-5")[0] == 1


def test_another_file_of_a_stranger_is_named_and_not_played(mine, tmp_path):
    """Its scores would say nothing of the record's."""
    path = submitted(mine, "--seeds", "test:0")
    changed = write_baseline(tmp_path / "changed", update="raise RuntimeError('played')")
    code, said, complaint = eitbench("verify", path, "--baseline", changed)
    assert code == 1 and said == "" and "the sha256 of mine.py is" in complaint


def test_numbers_decide_and_not_the_text(tmp_path, monkeypatch):
    """A record of ours is played whatever its words and digests are; of an older version it is said to be one."""
    path = submitted("homogeneous", "--seeds", "test:0")

    def reworded(record):
        record |= {"title": "Another title", "method_sha256": "0" * 64, "parameters": {"words": 1}}
        record["runs"] = [run | {"source": "0" * 64} for run in record["runs"]]

    code, said, complaint = eitbench("verify", forged(path, reworded))
    assert (code, complaint) == (0, "") and "as it says" in said and "now v" not in said
    code, _, complaint = eitbench("verify", forged(path, lambda record: record.update(role=None)))
    assert code == 1 and "role is 'floor', the record says None" in complaint
    monkeypatch.setattr(methods, "version_of", lambda path, sha256: "v2")
    code, said, _ = eitbench("verify", path)
    assert code == 0 and "the record is of v1, and homogeneous is now v2" in said
    code, said, complaint = eitbench("verify", forged(path, better))
    assert code == 1 and "is now v2" in said and "test:0: error is" in complaint


def test_the_cache_is_not_believed(mine, tmp_path, monkeypatch):
    """A cache in which test:0 is another, easier episode makes a better score, but no record that holds."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    world, seed = PIPE_2D.changed(SCENARIO), parse_seeds("test:0")[0]
    honest = simulate(world, seed, progress=False)
    level = np.full_like(honest.concentration, world.expected_concentration)
    flat = honest._replace(concentration=level)
    shutil.rmtree(folder(world))
    with monkeypatch.context() as patch:
        patch.setattr("eitbench.data.episodes.simulate_together", lambda *_: iter([flat]))
        path = submitted(mine, "--seeds", "test:0")
    assert list(folder(world).glob("*.truth.npz"))
    code, _, complaint = eitbench("verify", path, "--baseline", mine)
    assert code == 1 and "test:0: error is" in complaint
    assert cache_folder() == tmp_path / "cache"


# -- held-out episodes ------------------------------------------------------------------------------------------------


def test_held_out_seeds_are_the_formula():
    """SHA-256 of salt and number, outside the public ranges; by coreutils: the first of bytes 0 … 31 is e0bc…"""
    import hashlib
    seeds = drawn_seeds(SALT, 50)
    assert seeds[1] == int(hashlib.sha256(SALT + bytes(7) + b"\1").hexdigest(), 16) % 2**63
    assert len(set(seeds)) == 50 and max(split.stop for split in SPLITS.values()) <= min(seeds) < max(seeds) < 2**63
    assert drawn_seeds(SALT, 3) == seeds[:3] and drawn_seeds(SALT[::-1], 3) != seeds[:3]


def test_a_salt_is_its_owner_s_and_its_hash_everybody_s(tmp_path, monkeypatch):
    """A file that others cannot read, and never overwrites another; the published hash decides which salt counts."""
    code, said, _ = eitbench("held-out", "--new", "salt")
    assert code == 0 and (tmp_path / "salt").stat().st_mode & 0o777 == 0o600
    salt = salts.read_salt(tmp_path / "salt")
    told = json.loads((tmp_path / "leaderboards" / "held_out.json").read_text())
    assert told == {"salt_sha256": salts.hash_of(salt)} and told["salt_sha256"] in said and salt.hex() not in said
    code, _, complaint = eitbench("held-out", "--new", "next")
    assert code == 2 and "to draw another one, remove that file in a commit" in complaint
    assert not (tmp_path / "next").exists()
    with pytest.raises(ValueError, match="cannot be written"):
        salts.new_salt(tmp_path / "salt")
    assert salts.read_salt(tmp_path / "salt") == salt
    (tmp_path / "words").write_text("hello")
    salts.new_salt(tmp_path / "other")
    with monkeypatch.context() as patch, pytest.raises(ValueError, match="which guests may read"):
        patch.setattr(salts, "python_files", lambda: [tmp_path])
        salts.read_salt(tmp_path / "salt")
    for name, change, message in (("other", 0o600, "has the hash"), ("salt", 0o640, "readable by its owner only"),
                                  ("words", 0o600, "salt .*words must hold hexadecimal digits"),
                                  ("none", None, "cannot be read")):
        if change:
            (tmp_path / name).chmod(change)
        with pytest.raises(ValueError, match=message):
            salts.read_published_salt(tmp_path / name)


def test_the_published_hash_is_found_from_everywhere(tmp_path):
    """It is that of the checkout or the installed package, not of the working folder."""
    program = "from eitbench.bench.salts import PUBLISHED; print(PUBLISHED)"
    said = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, text=True, capture_output=True, check=True)
    assert Path(said.stdout.strip()) == Path(run.__file__).parents[2] / "leaderboards" / "held_out.json"


def held_out_claim(tmp_path, monkeypatch, mine, episodes=6):
    """Arguments of `verify` for held-out episodes alone, of a salt of zeros: one in twenty is bad luck."""
    monkeypatch.setattr(salts.secrets, "token_bytes", bytes)
    salts.new_salt(tmp_path / "salt")
    return "--episodes", 0, "--held-out", episodes, "--salt-file", "salt", "--baseline", mine


@walled
def test_held_out_episodes_tell_the_honest_from_the_prepared(mine, tmp_path, monkeypatch):
    """What the record says is no better than held-out; one that holds on public episodes only is."""
    public = submitted(mine, "--seeds", "test:0-7")
    claim = held_out_claim(tmp_path, monkeypatch, mine)
    code, said, complaint = eitbench("verify", public, *claim)
    assert code == 0 and salts.hash_of(bytes(32)) in said, complaint
    assert "record, 8 episodes" in said and "held-out, 6" in said
    assert all(re.search(rf"{name} *\|( +[\d.-]+ \|){{3}}", said)
               for name in ("ẽ_c over the floor's", "gain over the floor", "smallest ratio"))

    def much_better(record):
        for _ in range(20):
            better(record)

    code, said, complaint = eitbench("verify", forged(public, much_better), *claim)
    assert code == 1
    for name in ("ẽ_c over the floor's", "gain over the floor"):
        assert re.search(name + r": [\d.-]+ in the record, [\d.-]+ held-out; so much better is an honest", complaint)

    with monkeypatch.context() as patch:
        patch.setattr(run, "landlock_version", lambda: 0)
        code, _, complaint = eitbench("verify", public, *claim)
        assert code == 1 and "behind a wall only" in complaint
    code, _, complaint = eitbench("verify", public, *claim, "--isolate", "never")
    assert code == 1 and "behind a wall only" in complaint


@walled
def test_no_record_of_the_floor_is_believed(mine, tmp_path, monkeypatch):
    """A file with the truth of its test episodes; beside it a floor that is as good, first by file name."""
    honest = submitted(mine, "--seeds", "test:0-7")
    floor = submitted("homogeneous", "--seeds", "test:0-7")

    def with_the_truth(record, of=8):
        for episode in sorted(record["episodes"], key=lambda episode: episode["scores"]["error"])[-of:]:
            episode["step_errors"] = [1.2e-5 for _ in episode["step_errors"]]
            episode["scores"]["error"] = float(np.mean(episode["step_errors"]))

    def in_front(record):
        with_the_truth(record)
        record.update(version="00000000", method_sha256="0" * 64, official=False)
        for episode, true in zip(record["episodes"], read_record(floor)["episodes"], strict=True):
            episode["step_errors"] = [1.2e-5 * error for error in true["step_errors"]]
            episode["scores"]["error"] = float(np.mean(episode["step_errors"]))

    claim = held_out_claim(tmp_path, monkeypatch, mine)
    for of in (8, 2):                                       # all, or the hardest two
        prepared = forged(honest, lambda record, of=of: with_the_truth(record, of))
        assert forged(floor, in_front).name < floor.name
        code, _, complaint = eitbench("verify", prepared, *claim)
        assert code == 1 and "smallest ratio: " in complaint


@walled
def test_held_out_seeds_stay_here(mine, tmp_path, monkeypatch):
    """Neither a message to a guest, nor its command line or surroundings, nor what is printed has one, or the salt."""
    path = submitted(mine, "--seeds", "test:0-3")
    monkeypatch.setattr(salts.secrets, "token_bytes", bytes)      # zeros: one salt in twenty is bad luck
    salts.new_salt(tmp_path / "salt")
    seeds = drawn_seeds(salt := salts.read_salt(tmp_path / "salt"), 2)
    passed, popen, pack = [], host.subprocess.Popen, wire.pack

    def started(command, **rest):
        passed.append(repr((command, rest["env"], rest["cwd"])).encode())
        return popen(command, **rest)

    def packed(*message):
        passed.append(pack(*message))
        return passed[-1]

    monkeypatch.setattr(host.subprocess, "Popen", started)
    monkeypatch.setattr(wire, "pack", packed)
    played = []
    monkeypatch.setattr(held_out, "run_episode", lambda job: played.append(job.seed) or run.run_episode(job))
    code, said, complaint = eitbench("verify", path, "--episodes", 0, "--held-out", 2, "--salt-file", "salt",
                                     "--baseline", mine)
    assert code == 0, complaint
    assert played == [*seeds, *seeds, *parse_seeds("test:0-3")]
    assert sum(b'"update"' in message for message in passed) == 2 * 5
    for secret in (*(str(seed) for seed in seeds), *(f"{seed:x}" for seed in seeds), salt.hex()):
        assert secret not in said + complaint and not any(secret.encode() in message for message in passed)
    for secret in (salt, *(seed.to_bytes(8, order) for seed in seeds for order in ("little", "big"))):
        assert not any(secret in message for message in passed)


@pytest.mark.parametrize(("arguments", "message"), [
    (["--held-out", "3"], "--held-out and --salt-file belong together"),
    (["--salt-file", "salt"], "--held-out and --salt-file belong together"),
    (["--episodes", "0"], "--episodes must be at least 1 where no --held-out episodes are played, got 0"),
    (["--baseline", "a.py", "--policy", "b.py"], "only one of --baseline and --policy"),
])
def test_mistakes_are_explained(arguments, message):
    """Exit code 2, unlike that of an untrue record."""
    code, said, complaint = eitbench("verify", "record.json", *arguments)
    assert code == 2 and said == "" and message in complaint
    code, _, complaint = eitbench("verify", "record.json")
    assert code == 1 and "record record.json cannot be read" in complaint
