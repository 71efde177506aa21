"""Methods in guests: the same scores to the bit, failures of their own only, and nothing of a stranger's runs here."""

import json
import os
import re
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from eitbench.bench import suites
from eitbench.bench.methods import own_methods
from eitbench.bench.run import Job, run_episode, run_jobs
from eitbench.bench.sandbox import guests, host
from eitbench.bench.sandbox.wall import landlock_version
from eitbench.bench.store import EpisodeStore
from eitbench.bench.tracks import Environment
from eitbench.data.store import CACHE_VARIABLE
from eitbench.worlds.streams import randomness

from recorded import forget_made
from short import PIPE, merged
from tiny import FILTER, FIXED_LAG, SMOOTHING, without_namespaces, write_baseline

INJECTION = Environment("eitbench/Pipe2DInjection-v0", json.dumps({"world": PIPE, "estimator": "reduced"}))
WALL = "landlock" if landlock_version() else "process"

POLICY = '''"""Mine: chosen by lot."""


class Policy:
    def __init__(self, rules, random):
        self.rules, self.random = rules, random
        {init}

    def act(self, observation):
        {act}
'''
BY_LOT = "return int(self.random.integers(self.rules.action_space.n))"


ABOUT = """import os
from eitbench.bench.sandbox import wire
sound = {{"title": "Mine", "boards": ["filter"], "role": None, "parameters": {{}}, "suits": True}}
os.write(4, wire.pack(sound | {{{}}}))
"""
"""A file that answers for the process before it is loaded."""


@pytest.fixture(autouse=True)
def cache(run_cache, monkeypatch):
    """One cache of episodes for all tests of this session, and no guest left behind."""
    monkeypatch.setenv(CACHE_VARIABLE, run_cache)
    yield
    guests.close()


def write_policy(folder: Path, init: str = "pass", act: str = BY_LOT) -> str:
    path = folder / "by_lot.py"
    path.write_text(POLICY.format(init=init, act=act))
    return str(path)


def lasting(result):
    """All of a result but clocks and memory."""
    scores = {name: value for name, value in result.get("scores", {}).items() if name != "seconds_per_step"}
    return {key: value for key, value in result.items() if key not in ("finished", "seconds", "peak_memory")} | {
        "scores": scores}


@pytest.mark.parametrize("environment", [FILTER, FIXED_LAG, SMOOTHING, INJECTION],
                         ids=["filter", "fixed-lag", "smoothing", "injection"])
def test_scores_are_the_same_to_the_bit(environment, tmp_path):
    """An estimator that uses all it sees and claims all it may; a policy that lives by its random numbers."""
    path = write_policy(tmp_path) if environment is INJECTION else write_baseline(
        tmp_path, parameters="{'a': [1, 2.5]}", update="self.level = self.level + voltages.sum() + 0.1 * self.calls; "
        "return Estimate(self.level, self.level**2, voltages, np.eye(4) + np.outer(voltages, voltages)) "
        "if self.calls > self.task.lag else None")
    for seed in (1, 2):                                                 # one guest plays both
        (here, fields), (there, others) = (run_episode(Job(environment, path, seed, isolated))
                                           for isolated in (False, True))
        assert here["status"] == "ok" and lasting(here) == lasting(there)
        assert set(fields) == set(others) and all((fields[name] == others[name]).all() for name in fields)
        assert here["peak_memory"] is None and 50e6 < there["peak_memory"] < 8e9
        assert there["scores"]["seconds_per_step"] > 0


def test_a_policy_is_told_the_same_rules(tmp_path):
    """Where the first frame is measured before its first injection, a budget is spread over the steps that are left."""
    budget = Environment("eitbench/Pipe2DInjectionBudget-v0", json.dumps({
        "world": merged(PIPE, {"schedule": {"budget": 2}}), "estimator": "reduced"}))
    path = write_policy(tmp_path, act="raise RuntimeError(repr([self.rules.spaced([left, 1.0]) "
                                      "for left in range(7)]))")
    here, there = (run_episode(Job(budget, path, 1, isolated))[0] for isolated in (False, True))
    assert here["message"] == there["message"] and "True" in here["message"] and "False" in here["message"]


@pytest.mark.parametrize("isolated", [False, True])
def test_a_policy_is_not_told_what_its_numbers_were_drawn_from(isolated, tmp_path):
    """Its generator draws other numbers in each episode, and knows numbers that follow from those; no seed is there."""
    init = "seeds = self.random.bit_generator.seed_seq\n        self.known = repr((seeds, seeds.entropy, seeds.state))"
    path = write_policy(tmp_path, init, "raise RuntimeError(f'{self.known} draws {self.random.integers(2**63)}')")
    said = [run_episode(Job(INJECTION, path, seed, isolated))[0]["message"].split(" draws ") for seed in (1, 2)]
    assert said[0][1] != said[1][1]
    for seed, (known, _) in zip((1, 2), said, strict=True):             # what it was seeded with: 128-bit numbers
        assert min(map(int, re.findall(r"\d{10,}", known))) > 2**64 and f"entropy={seed}" not in known
    expected = np.random.default_rng(int(randomness(1).policy.integers(2**63))).integers(2**63)
    assert said[0][1] == str(expected)                                  # records of before stay what they are


def test_ours_play_there_too(tmp_path):
    """By name, as ``always`` asks; their scores are those of here."""
    here, there = (run_episode(Job(FILTER, "homogeneous", 1, isolated))[0] for isolated in (False, True))
    assert here["status"] == "ok" and lasting(here) == lasting(there)


def test_nothing_of_a_stranger_s_file_runs_here(tmp_path, monkeypatch):
    """Not even to learn its name: neither in this process nor in a worker; ours does, which proves the trap."""
    trap = tmp_path / "trap"
    path = write_baseline(tmp_path)
    Path(path).write_text(Path(path).read_text() + f"\ntry:\n    open({str(trap)!r}, 'a').write(str(os.getppid()))\n"
                          "except OSError:\n    pass\n")
    store = EpisodeStore(tmp_path / "results")
    monkeypatch.setattr(suites, "QUICK", (FILTER.id,))
    run_jobs([Job(FILTER, path, seed, True) for seed in (1, 2)], store, n_jobs=2)
    if WALL == "landlock":
        assert not trap.exists()
    assert {result["status"] for result in store.results()} == {"ok"}
    (record,) = store.write_records()
    assert [run["isolation"] for run in record["runs"]] == [WALL]
    assert all(episode["peak_memory"] > 50e6 for episode in record["episodes"])
    Job(FILTER, path, 1).load()
    assert trap.exists()


@pytest.mark.parametrize(("statement", "message", "lives"), [
    ("raise KeyError('oh')", "KeyError: 'oh'", True),
    ("return 7", "ValueError: Estimator.update must return an Estimate or None, got int", True),
    ("return Estimate(self.level[:3])", r"shape \(1701,\), got \(3,\)", True),
    ("return None", "t = 1 it returned None", True),
    ("os._exit(3)", "ended with status 3", False),
    ("__import__('time').sleep(60)", "no answer within 3 s", False),
])
def test_what_goes_wrong_is_the_episode_s(statement, message, lives, tmp_path):
    """An exception with its place, nonsense, a crash, silence; the next episode finds a guest that answers."""
    path = write_baseline(tmp_path, update=f"if voltages[0] != 0.0: {statement}\n        return Estimate(self.level)")
    job = Job(FILTER, path, 1, True)
    job.load()
    first = guests._present[0][1]
    first._patience = 3.0
    result, fields = run_episode(job)
    assert result["status"] == "failed" and re.search(message, result["message"]) and not fields
    assert first.alive == lives and (result["peak_memory"] is None) != lives
    if lives:
        here = run_episode(job._replace(isolated=False))[0]
        assert lasting(result) | {"where": ""} == lasting(here) | {"where": ""}
        assert result["where"] == here["where"] or statement == "return 7"
    job.load().make(None).update(np.zeros(4), np.zeros(4))
    assert guests._present[0][1].alive and (guests._present[0][1] is first) == lives


def test_one_guest_at_a_time_and_none_at_the_end(tmp_path, monkeypatch):
    """One is enough for all episodes of a method; another method's takes its place, and a run leaves nothing."""
    made = []

    class Counted(host.Guest):
        def __init__(self, *arguments, **rest):
            assert all(not guest.alive for guest in made)
            super().__init__(*arguments, **rest)
            made.append(self)

    monkeypatch.setattr(guests, "Guest", Counted)
    first, second = (write_baseline(tmp_path, name) for name in ("first", "second"))
    run_jobs([Job(FILTER, path, seed, True) for path in (first, second) for seed in (1, 2)],
             EpisodeStore(tmp_path / "results"))
    assert len(made) == 4                             # two to say what they are, two that play
    assert not any(guest.alive or guest._private.exists() for guest in made)


def test_workers_leave_nothing_behind(tmp_path):
    """Neither processes nor folders, when the program is over."""
    path = write_baseline(tmp_path, update="return Estimate(self.level + 0 * os.getpid())")
    program = ("from pathlib import Path; from eitbench.bench.run import *\n"
               f"jobs = [Job(Environment(*{list(FILTER)!r}), {path!r}, seed, True) for seed in (1, 2, 3)]\n"
               f"run_jobs(jobs, EpisodeStore(Path({str(tmp_path / 'results')!r})), n_jobs=2)")
    folder = tmp_path / "temporary"
    folder.mkdir()
    subprocess.run([sys.executable, "-c", program], check=True, env=os.environ | {"TMPDIR": str(folder)})
    assert {r["status"] for r in EpisodeStore(tmp_path / "results").results()} == {"ok"}
    assert not list(folder.glob("eitbench-guest-*"))


STUBBORN = """import ctypes
        ctypes.CDLL(None).prctl(1, 0, 0, 0, 0)
        for role in ("guest", "child"):
            Path.home().joinpath(f"{role}-{os.readlink('/proc/self')}").touch()
            if role == "guest" and os.fork():
                break
            for leave in (os.setsid, os.setpgrp):
                try:
                    leave()
                except OSError:
                    pass
        while True: pass"""
"""It will not hear of the death of its parents, has a child that neither does, and never answers."""
SUBMIT = """import json, sys
from eitbench.bench.submit import submit
from eitbench.bench.store import EpisodeStore
from eitbench.bench import suites, tracks
from eitbench.bench.tracks import Environment
id, kwargs, path, folder, n_jobs = sys.argv[1:]
before = suites.Environment
suites.Environment = lambda id, given: before(id, kwargs)
from pathlib import Path
list(submit(path, [id], [200_000, 200_001, 200_002], EpisodeStore(Path(folder)), Path(folder), n_jobs=int(n_jobs)))
"""
"""As `eitbench submit`, in a world whose episodes take a moment."""


def alive(number):
    """Whether there is such a process, other than one whose parent has not asked how it ended."""
    status = Path("/proc", str(number), "status")
    try:
        return "State:\tZ" not in status.read_text()
    except OSError:
        return False


def waited(found, seconds):
    """What ``found`` finds, as soon as it is something."""
    until = time.monotonic() + seconds
    while not (there := found()):
        assert time.monotonic() < until
        time.sleep(0.05)
    return there


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="nobody ends a child elsewhere")
@pytest.mark.parametrize("victim", ["host", "host without namespaces", "worker", "host of workers"])
def test_nobody_outlives_a_killed_host(victim, tmp_path):
    """Neither guests that do all they can, nor their children, nor workers; their folders are gone too."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    path = write_baseline(tmp_path, update=STUBBORN)
    n_jobs = 2 if "worker" in victim else 1
    program = SUBMIT if "without" not in victim else (
        f"from eitbench.bench.sandbox import keeper\nkeeper.__file__ = {without_namespaces(tmp_path)!r}\n{SUBMIT}")
    arguments = [FILTER.id, FILTER.kwargs, path, str(tmp_path / "results"), str(n_jobs)]
    with subprocess.Popen([sys.executable, "-c", program, *arguments], stderr=subprocess.DEVNULL,
                          env=os.environ | {"TMPDIR": str(folder)}) as submitting:
        def family():
            there = [int(each.name.split("-")[1]) for each in folder.glob("eitbench-guest-*/*-*")]
            return there if len(there) == 2 * n_jobs else []

        try:
            players = waited(family, 90.0)
            workers = [int(each.name) for each in Path("/proc").glob("[0-9]*")
                       if started_by(each) == submitting.pid and "popen_loky" in (each / "cmdline").read_text()]
            assert len(workers) >= (2 if n_jobs == 2 else 0)
            os.kill(workers[0] if victim == "worker" else submitting.pid, 9)
            waited(lambda: not any(map(alive, (*players, *workers))), 5.0)
            if victim != "worker":                        # joblib then kills whoever descends from the others
                waited(lambda: not list(folder.glob("eitbench-guest-*")), 5.0)
        finally:
            submitting.kill()


def started_by(process):
    """The parent of a process in /proc."""
    try:
        return int(re.search(r"PPid:\t(\d+)", (process / "status").read_text())[1])
    except OSError:
        return None


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="nobody ends a child elsewhere")
def test_a_guest_ends_with_who_started_it(tmp_path):
    """Even if a killed worker leaves it in an endless loop."""
    path = write_baseline(tmp_path, update="while True: pass")
    program = ("import numpy as np; from eitbench.bench.sandbox.host import Guest\n"
               f"guest = Guest('estimation', {FILTER.id!r}, {json.loads(FILTER.kwargs)!r}, {path!r})\n"
               "guest.begin(); print(guest._process.pid, flush=True); guest.update(np.zeros(4), np.zeros(4))")
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True,
                          env=os.environ | {"TMPDIR": str(tmp_path)}) as host_:
        assert host_.stdout is not None
        guest = Path("/proc", host_.stdout.readline().strip())
        time.sleep(0.5)
        assert guest.exists()
        host_.kill()
    end = time.monotonic() + 20.0
    while guest.exists() and "State:\tZ" not in (guest / "status").read_text():
        assert time.monotonic() < end
        time.sleep(0.1)


def test_a_file_that_changes_meanwhile_is_not_played(tmp_path):
    """What is recorded is of one file; a fresh guest would play another."""
    path = write_baseline(tmp_path)
    loaded = Job(FILTER, path, 1, True).load()
    guests.close()
    write_baseline(tmp_path, update="raise RuntimeError('changed')")
    with pytest.raises(host.GuestError, match="was changed while it was being played"):
        loaded.make(None)


@pytest.mark.parametrize(("said", "message"), [
    ("class Estimator: pass", "mine.py must define a class Estimator with a method update"),
    ("raise SystemExit(3)", "cannot be played: SystemExit: 3"),
    ("import os; os._exit(4)", "ended with status 4"),
    ("class Estimator:\n    def update(self, v, i): pass\nimport eitbench.bench.methods as b\n"
     "b.title_of = lambda *_: 7", "says nonsense of its title"),
    ("class Estimator:\n    def update(self, v, i): pass\nimport eitbench.bench.methods as b\n"
     "b.BOARDS = {'estimation': [[1]]}\nEstimator.boards = [[1]]\n"
     "b.set = lambda _: type('S', (), {'__le__': lambda *_: True})()",
     "says nonsense of its boards"),
    *((f"class Estimator:\n    def update(self, v, i): pass\nimport eitbench.bench.methods as b\n"
       f"b._parameters = lambda *_: {said}", "mine.py.*(parameters|JSON)")
      for said in ("{'a': 'b' * 10_000}", "{'a': float('inf')}", "{'a': [[]] * 900_000}")),
    ("class Estimator:\n    def update(self, v, i): pass\nimport eitbench.bench.methods as b\n"
     "b.title_of = lambda *_: 'a' * 121", "says nonsense of its title"),
    (ABOUT.format("'boards': 7"), "says nonsense of its boards"),
    (ABOUT.format("'boards': [{}]"), "says nonsense of its boards"),
    (ABOUT.format("'role': [], 'name': None, 'title': 7"), "says nonsense of its title, role"),
    ("import os\nhead = b'[{\"parameters\": 1e999}, []]'\n"
     "os.write(4, len(head).to_bytes(8, 'little') + bytes(8) + head)", "1e999"),
])
def test_files_that_cannot_be_played(said, message, tmp_path):
    """A ``ValueError`` that names the file, also if the file makes the process lie."""
    path = tmp_path / "mine.py"
    path.write_text(said)
    with pytest.raises(ValueError, match=message) as caught:
        Job(FILTER, str(path), 1, True).load()
    assert str(path) in str(caught.value)


def test_a_guest_does_not_choose_its_name(tmp_path, monkeypatch):
    """Results are kept under it: those of a file that calls itself like ours would take the place of ours."""
    path = Path(write_baseline(tmp_path))
    path.write_text(path.read_text() + "\nimport eitbench.bench.methods as b\nmade = b.Method\n"
                    "b.Method = lambda track, name, *rest: made(track, 'homogeneous', *rest)\n")
    assert Job(FILTER, str(path), 1, True).load().name == "mine"
    agent = tmp_path / "model.zip"
    agent.write_bytes(b"")
    ours = tmp_path / "ppo" / "seed3" / "model.zip"
    ours.parent.mkdir(parents=True)
    ours.with_name("sha256").write_text("another")
    own = guests.own_files
    monkeypatch.setattr(guests, "own_files", lambda id: own(id) | {"ppo_seed3": ours})
    about = {"title": "Mine", "boards": ["injection"], "parameters": {}, "role": None, "suits": True}
    for name, refused in (("ppo_seed3", True), ("random_pair", True), ("ppo_seed4", False)):
        forget_made(guests)
        monkeypatch.setattr(guests, "_enter", lambda *_, name=name: SimpleNamespace(about=about | {"name": name}))
        with pytest.raises(ValueError, match=f"model.zip has the name of one of ours, {name}") if refused else (
                nullcontext()):
            assert Job(INJECTION, str(agent), 1, True).load().name == name
    forget_made(guests)


def test_ours_are_ours_by_path_too(tmp_path):
    """Nobody's copy, which would be refused as having the name of one of ours."""
    ours = os.path.relpath(Path(__file__).parents[2] / "baselines" / "homogeneous.py")
    assert Job(FILTER, ours, 1, True).load().name == "homogeneous"


def test_who_is_isolated(tmp_path):
    """By default what is not ours, whatever its path; the privileged cannot be."""
    mine, ours = write_baseline(tmp_path), "baselines/homogeneous.py"
    root = Path(__file__).parents[2]
    for method, expected in ((mine, (False, True, True)), ("homogeneous", (False, False, True)),
                             (str(root / ours), (False, False, True)),
                             (str(root / "baselines" / ".." / "tests" / "mine.py"), (False, True, True))):
        assert tuple(suites.is_isolated(FILTER, method, how) for how in suites.ISOLATE) == expected
    assert [name for name in own_methods("injection")
            if not suites.is_isolated(INJECTION, name, "always")] == ["clairvoyant"]
    privileged = write_policy(tmp_path)
    text = Path(privileged).read_text()
    Path(privileged).write_text(text.replace("class Policy:", "class Policy:\n    privileged = True"))
    with pytest.raises(ValueError, match=r"by_lot.py is privileged: it asks for the truth"):
        Job(INJECTION, privileged, 1, True).load()
    with pytest.raises(ValueError, match="isolate must be one of never, others, always"):
        suites.is_isolated(FILTER, mine, "sometimes")


def test_jobs_are_ordered_for_guests(tmp_path):
    """All seeds of a method together, environment by environment."""
    paths = [write_baseline(tmp_path, name) for name in ("first", "second")]
    todo = suites.jobs("estimation", [SMOOTHING.id, FILTER.id], paths, [1, 2], isolate="never")
    assert [(job.environment.id, job.method, job.seed) for job in todo] == [
        (id, path, seed) for id in (SMOOTHING.id, FILTER.id) for path in paths for seed in (1, 2)]
