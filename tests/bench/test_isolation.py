"""Third-party methods in a separate process: the same scores, and no access to the outside under bubblewrap."""

import gc
import io
import json
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import time
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest
from eitbench.bench import isolation
from eitbench.bench.isolation import Limits, Worker, WorkerError, bubblewrap_problem, choose_isolation
from eitbench.bench.run import Job, make_jobs, run_episode, run_jobs
from eitbench.bench.store import EpisodeStore
from eitbench.bench.tracks import Environment
from eitbench.data.cache import CACHE_VARIABLE
from eitbench.data.episodes import simulate
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from short import TINY, world
from tiny import FILTER, FIXED_LAG, ISOLATION, confined, write_baseline, write_policy

ROOT = Path(__file__).parents[2]
POLICY_ID = "eitbench/Pipe2DInjection-v0"
INJECTION = Environment(POLICY_ID, json.dumps(world(POLICY_ID) | {"estimator": "reduced"}))


@pytest.fixture(autouse=True)
def cache(run_cache, monkeypatch):
    """Use one cache for all tests of this session, and close all workers."""
    monkeypatch.setenv(CACHE_VARIABLE, run_cache)
    yield
    isolation.close()


def worker(path, kind="bubblewrap", **how):
    return closing(Worker("estimation", FILTER.id, json.loads(FILTER.kwargs), path, kind, **how))


def ask(path, kind="bubblewrap", *, reply_timeout=60.0, **how):
    """Run the file for some steps; return the exception."""
    with worker(path, kind, **how) as there:
        there(None)
        there.reply_timeout = reply_timeout
        with pytest.raises(WorkerError) as caught:
            there.update(np.zeros(4), np.zeros(4))
        return str(caught.value), there.is_alive


def lasting(result):
    """Return a result without times and memory."""
    scores = {name: value for name, value in result.get("scores", {}).items() if name != "seconds_per_step"}
    return {key: value for key, value in result.items() if key not in ("finished", "seconds", "peak_memory")} | {
        "scores": scores}


def write_fields(folder):
    """Write an estimator that reports every field."""
    return write_baseline(folder, parameters="{'a': [1, 2.5]}", update=(
        "self.level = self.level + voltages.sum() + 0.1 * self.calls; "
        "return Estimate(self.level, self.level**2, voltages, np.eye(4) + np.outer(voltages, voltages)) "
        "if self.calls > self.task.lag else None"))


@pytest.mark.parametrize(("environment", "kind", "write"), [
    (FIXED_LAG, "process", write_fields), (INJECTION, ISOLATION, write_policy),
    (FILTER, ISOLATION, lambda _: "log_inflow_filter")], ids=["lag", "injection", "built-in"])
def test_scores_are_identical(environment, kind, write, tmp_path, monkeypatch):
    """Test an estimator that reports every field, a policy that depends on its random numbers, and a built-in method
    with a joint covariance by name; one worker runs both episodes. The state of a policy's generator, which is sent,
    does not reveal the seed."""
    sent = []
    encode = isolation.encode_message
    monkeypatch.setattr(isolation, "encode_message", lambda content: sent.append(content) or encode(content))
    path = write(tmp_path)
    for seed in (1, 2):
        (here, fields), (there, others) = (run_episode(Job(environment, path, seed, each)) for each in ("none", kind))
        assert here["status"] == "ok" and lasting(here) == lasting(there)
        assert set(fields) == set(others)
        assert all(np.array_equal(fields[name], others[name], equal_nan=True) for name in fields)
        assert here["peak_memory"] is None and 50e6 < there["peak_memory"] < 8e9
    assert sum(each["do"] == "load" for each in sent) == 1
    states = [each["random"]["state"] for each in sent if each["do"] == "begin" and each["random"]]
    if environment is INJECTION:
        assert states[0] != states[1] and min(value for state in states for value in state.values()) > 2**31


def test_one_process_runs_the_episodes_of_a_method(tmp_path, monkeypatch):
    """A process loads a method, another runs its episodes and ends with the run; this process never executes the
    file, not even to read its title."""
    made, trap, start = [], tmp_path / "trap", Worker.start

    def counted(self):
        if not self.is_alive:
            made.append(self)
        start(self)
        assert sum(each.is_alive for each in {*made}) == 1

    monkeypatch.setattr(Worker, "start", counted)
    paths = [write_baseline(tmp_path, name) for name in ("first", "second")]
    for path in map(Path, paths):
        path.write_text(f"{path.read_text()}\nopen({str(trap)!r}, 'a').write(f'{{os.getpid()}} ')\n")
    store = EpisodeStore(tmp_path / "results")
    run_jobs([Job(FILTER, path, seed, "process") for path in paths for seed in (1, 2)], store)
    assert len(made) == 4 and not any(each.is_alive or each._home.exists() for each in made)
    records = store.write_records()
    assert [each["isolation"] for record in records for each in record["runs"]] == ["process", "process"]
    assert all(episode["peak_memory"] > 50e6 for record in records for episode in record["episodes"])
    pids = set(map(int, trap.read_text().split()))
    assert len(pids) == 4 and os.getpid() not in pids
    Job(FILTER, paths[0], 1).load()
    assert str(os.getpid()) in trap.read_text()           # execution in this process would be detected


@pytest.mark.parametrize(("method", "isolate", "strict", "expected"), [
    ("homogeneous", "auto", False, "none"), ("homogeneous", "auto", True, "none"),
    ("homogeneous", "process", True, "process"), ("true_model_smoother", "process", True, "none"),
    ("mine.py", "auto", False, "process"), ("mine.py", "none", False, "none"), ("mine.py", "process", True, "process"),
])
def test_isolation_depends_on_method_and_option(method, isolate, strict, expected):
    """Built-in files run in this process by default, third-party files never if that is strict."""
    assert choose_isolation(FILTER, method, isolate, strict=strict) == expected


def test_third_party_files_need_bubblewrap_where_strict(monkeypatch):
    """The message explains why it is missing and how to install it."""
    monkeypatch.setattr(isolation, "bubblewrap_problem", lambda: "bubblewrap is not installed")
    for asked in ({"strict": True}, {"isolate": "bubblewrap"}):
        with pytest.raises(ValueError, match=r"is not installed; install bubblewrap \(apt-get install bubblewrap\), "
                                             r"or .* --isolate process"):
            choose_isolation(FILTER, "mine.py", **asked)
    with pytest.raises(ValueError, match="isolate must be bubblewrap or process"):
        choose_isolation(FILTER, "mine.py", "none", strict=True)
    with pytest.raises(ValueError, match="isolate must be one of auto, none, process, bubblewrap; got 'never'"):
        make_jobs("estimation", [FILTER.id], ["homogeneous"], [1], isolate="never")


def test_a_kernel_that_forbids_namespaces_is_recognised(monkeypatch, tmp_path):
    """One probe returns the reason."""
    program = tmp_path / "bwrap"
    program.write_text("#!/bin/sh\necho 'bwrap: setting up uid map: Permission denied' >&2\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    assert "setting up uid map: Permission denied" in bubblewrap_problem.__wrapped__()


ATTEMPTS = {
    "the ground truth": "Path(FOLDER, 'truth.npz').read_bytes()",
    "the cache": "os.listdir(FOLDER)",
    "the checkout": "Path(ROOT, 'README.md').read_text()",
    "password hashes": "open('/etc/shadow').read()",
    "the user's home": "Path(FOLDER, 'mine.txt').write_text('mine')",
    "the built-in methods": "Path(ROOT, 'baselines', 'escape.tmp').write_text('mine')",
    "TCP": "socket.create_connection(('127.0.0.1', PORT), timeout=5)",
    "a service's socket": "socket.socket(socket.AF_UNIX).connect(FOLDER + '/service')",
    "an abstract socket": "socket.socket(socket.AF_UNIX).connect('\\0' + FOLDER)",
    "the host's variables": "Path(f'/proc/{HOST}/environ').read_bytes()",
    "the host's memory": "open(f'/proc/{HOST}/mem', 'rb')",
    "the host's process": "os.kill(HOST, 0)",
    "inherited variables": "os.environ['EITBENCH_TEST_SECRET']",
    "shared memory": "Path('/dev/shm', SHARED).read_bytes()",
    "another root": "os.chroot('/')",
    "the truth in memory": "found(SHAPE) or 1 / 0",
}
TRY = """
import gc, os, socket
from pathlib import Path
def found(shape):
    held = [value for each in gc.get_objects() if type(each) is dict for value in each.values()]
    return any(type(value).__name__ == "ndarray" and list(value.shape) == shape for value in held)
reached = []
for what, deed in ATTEMPTS.items():
    try:
        eval(deed)
        reached.append(what)
    except (OSError, KeyError, ZeroDivisionError):
        pass
"""
NEEDS_ROOT = {"password hashes", "another root"}


@pytest.fixture(scope="module")
def reached(tmp_path_factory):
    """Results of the attacks in this process, and under bubblewrap."""
    folder = tmp_path_factory.mktemp("secret")
    truth = simulate(TINY, 3, progress=False).concentration
    here = {"truth": truth, "a container, which the collector lists": []}
    np.savez(folder / "truth.npz", truth)
    shared = Path("/dev/shm", f"eitbench-test-{os.getpid()}")
    shared.write_text("secret")
    os.environ["EITBENCH_TEST_SECRET"] = "secret"
    with (socket.create_server(("127.0.0.1", 0)) as server, socket.socket(socket.AF_UNIX) as service,
          socket.socket(socket.AF_UNIX) as abstract):
        service.bind(str(folder / "service"))
        abstract.bind(f"\0{folder}")
        service.listen()
        abstract.listen()
        known = {"FOLDER": str(folder), "ROOT": str(ROOT), "HOST": os.getpid(), "SHARED": shared.name,
                 "PORT": server.getsockname()[1], "SHAPE": list(here["truth"].shape), "ATTEMPTS": ATTEMPTS}
        source = "\n".join(f"{name} = {value!r}" for name, value in known.items()) + TRY
        within = {}
        gc.collect()
        try:
            exec(source, within)
            path = write_baseline(folder, init=f"exec({source!r}, globals())",
                                  update="raise RuntimeError(f'reached {reached}')")
            there = ask(path)[0]
        finally:
            (ROOT / "baselines" / "escape.tmp").unlink(missing_ok=True)
            shared.unlink()
            del os.environ["EITBENCH_TEST_SECRET"]
    assert there.startswith("RuntimeError: reached [")
    return within["reached"], there


@confined
@pytest.mark.parametrize("what", ATTEMPTS)
def test_attacks_fail(what, reached):
    """Without bubblewrap the same code succeeds, unless it requires root."""
    here, there = reached
    assert what in here or (what in NEEDS_ROOT and os.getuid())
    assert repr(what) not in there


FORK = """
        children = 0
        try:
            while True:
                if not os.fork():
                    {child}
                    __import__("time").sleep(60)
                    os._exit(0)
                children += 1
        except OSError:
            raise RuntimeError("refused") if children < 200 else None
"""


EXCEPTIONS = [
    ("raise KeyError('oh')", "KeyError: 'oh'"), ("raise SystemExit('bye')", "SystemExit: bye"),
    ("return 7", "must return an Estimate or None, got int"), ("np.ones(2**29)", "MemoryError"),
    ("return Estimate(np.array([object()]))", "numeric in arrays")]


def test_exceptions_and_output_are_shown(tmp_path, capsys):
    """A worker survives exceptions, lack of memory and invalid results. Printed text is limited, without control
    characters, and prefixed with the method's name."""
    steps = [f"if self.calls == {k}: {statement}" for k, (statement, _) in enumerate(EXCEPTIONS, 1)]
    path = write_baseline(tmp_path, init="print('made\\x1b[2J'); print('x' * 20_000)", update="\n        ".join(steps))
    with worker(path, ISOLATION, limits=Limits(memory=3 << 30)) as there:
        there(None)
        for _, message in EXCEPTIONS:
            with pytest.raises(WorkerError, match=message):
                there.update(np.zeros(4), np.zeros(4))
            assert there.is_alive
    printed = capsys.readouterr().err
    assert "[mine] made\\x1b[2J\n[mine] xxx" in printed and len(printed) < 11_000


@pytest.mark.parametrize(("statement", "reply_timeout", "message"), [
    ("os._exit(3)", 60.0, "ended with status 3"), ("while True: pass", 0.5, "TimeoutError: no reply within 0.5 s"),
    ("os.write(4, (2**62).to_bytes(8, 'little') * 2)", 60.0, "ValueError: a message must have at most"),
])
def test_failures_end_the_worker(statement, reply_timeout, message, tmp_path):
    said, is_alive = ask(write_baseline(tmp_path, update=statement), ISOLATION, reply_timeout=reply_timeout)
    assert re.search(message, said) and not is_alive


FILL = "[open(f'{Path.home()}/{k}', 'wb').write(bytes(2**20)) for k in range(200)]; raise RuntimeError('wrote all')"


@confined
@pytest.mark.parametrize(("update", "limits", "message"), [
    (FORK.format(child="pass"), Limits(threads=100),
     "ResourceLimitError: it started more than 100|RuntimeError: refused"),
    (FORK.format(child="kept = np.ones(2**25)"), Limits(memory=2 << 30),
     "ResourceLimitError: it held more than 2048 MiB|MemoryError"),
    (FILL, Limits(disk=100 << 20), "No space left"),
], ids=["processes", "memory of all processes", "disk"])
def test_limits_hold_for_all_its_processes(update, limits, message, tmp_path):
    """Processes are also counted by the parent, because the kernel does not count processes of root. The only writable
    folder is in memory and has a limited size."""
    assert re.search(message, ask(write_baseline(tmp_path, update=update), limits=limits)[0])


STUBBORN = """
        if os.fork():
            while True: pass
        for leave in (os.setsid, os.setpgrp):
            try:
                leave()
            except OSError:
                pass
        while True: pass
"""


def test_workers_end_with_their_parent(tmp_path):
    """Workers end even if their parent is killed; under bubblewrap their children in other sessions end too."""
    paths = {kind: write_baseline(tmp_path, kind, update=STUBBORN if kind == "bubblewrap" else "while True: pass")
             for kind in ("process", ISOLATION)}
    program = ("import json, time, numpy as np; from eitbench.bench import isolation\n"
               f"for kind, path in {paths!r}.items():\n"
               f"    there = isolation.Worker('estimation', {FILTER.id!r}, {json.loads(FILTER.kwargs)!r}, path, kind)\n"
               "    there(None); isolation._started.clear(); there._process.stdin.write(isolation.encode_message("
               "{'do': 'update', 'voltages': np.zeros(4), 'currents': np.zeros(4)})); there._process.stdin.flush()\n"
               "    time.sleep(1.0); print(*there._family(), end=' ')\n"
               "print(flush=True); time.sleep(60)")
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as host:
        family = [int(pid) for pid in host.stdout.readline().split()]
        assert len(family) >= (5 if ISOLATION == "bubblewrap" else 1) and all(map(is_running, family))
        host.send_signal(signal.SIGKILL)
    until = time.monotonic() + 20.0
    while any(map(is_running, family)):
        assert time.monotonic() < until
        time.sleep(0.05)


def is_running(pid):
    """Return whether the process exists and has not ended as a zombie."""
    with suppress(OSError):
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    return False


def test_an_unread_request_times_out(tmp_path):
    """A worker may reply in advance without reading, until the pipe is full."""
    ahead = ("from eitbench.bench.isolation import encode_message\n        os.write(4, encode_message({}))\n"
             "        while True: os.write(4, encode_message({'estimate': None}))")
    with worker(write_baseline(tmp_path, init=ahead), "process") as there:
        there(None)
        there.reply_timeout = 0.5
        with pytest.raises(WorkerError, match=r"TimeoutError: no reply within 0\.5 s"):
            for _ in range(100):
                there.update(np.zeros(1000), np.zeros(1000))
        assert not there.is_alive


def test_secrets_must_be_outside_readable_folders():
    """The cache and a maintainer's secret must be outside the folders that workers can read."""
    place = next(place for place in isolation.readable_paths() if place.is_dir() and "packages" in place.name)
    with pytest.raises(ValueError, match=r"the cache folder .* must lie outside .*, which isolated methods can read"):
        isolation.check_out_of_reach(place / "cache", "the cache folder")
    isolation.check_out_of_reach(ROOT / "leaderboards" / "held_out.json", "a record")


def test_a_failure_names_the_users_line(tmp_path):
    """The result of a failed episode has the line of the user's file, also from another process; after a crash the next
    episode has a new process, which runs the content that was loaded."""
    path = write_baseline(tmp_path, update="if self.task and voltages[0] != 0.0: raise KeyError('oh')")
    here, there = (run_episode(Job(FILTER, path, 1, kind)) for kind in ("none", "process"))
    assert lasting(there[0]) == lasting(here[0]) and not there[1]
    assert there[0]["status"] == "failed" and there[0]["where"].startswith("mine.py:")
    loaded = Job(FILTER, path, 1, "process").load()
    isolation.close()
    write_baseline(tmp_path, update="raise RuntimeError('changed')")
    assert loaded.make(None).update(np.zeros(4), np.zeros(4)) is None and loaded.make.is_alive


VALID = {"title": "Mine", "subtracks": ["filter"], "role": None, "privileged": False, "parameters": {}, "suits": True}


@pytest.mark.parametrize(("changes", "message"), [
    ({"title": "a\x1b[2J"}, "reports an invalid title"), ({"subtracks": [{}]}, "subtracks must be some of"),
    ({"privileged": True}, "is privileged"), ({"name": "homogeneous"}, "")])
def test_forged_attributes_are_rejected(changes, message, tmp_path, monkeypatch):
    """A worker may report anything, but does not choose its name, under which results are stored."""
    monkeypatch.setattr(Worker, "start", lambda self: self.about.update(VALID | changes))
    path = write_baseline(tmp_path)
    if message:
        with pytest.raises(ValueError, match=message) as caught:
            Job(FILTER, path, 1, "process").load()
        assert str(path) in str(caught.value)
    else:
        assert Job(FILTER, path, 1, "process").load().name == "mine"


@pytest.mark.parametrize(("content", "message"), [
    ("import os; os._exit(4)", "ended with status 4"),
    ("import os\nfrom eitbench.bench.isolation import encode_message\nos.write(4, encode_message({'title': 7}))",
     "reports an invalid title")])
def test_files_that_cannot_be_loaded_are_named(content, message, tmp_path):
    """A ``ValueError`` has the path, also if the file replies in place of its process before it is loaded."""
    path = tmp_path / "mine.py"
    path.write_text(content)
    with pytest.raises(ValueError, match=message) as caught:
        Job(FILTER, str(path), 1, "process").load()
    assert str(path) in str(caught.value)
    with pytest.raises(ValueError, match="has the name of a built-in method"):
        Job(FILTER, write_baseline(tmp_path, "homogeneous"), 1, "process").load()


numbers = hnp.arrays(st.sampled_from([np.float64, np.float32, np.int64, np.bool_]),
                     hnp.array_shapes(min_dims=0, min_side=0))


@settings(max_examples=30)
@given(st.dictionaries(st.text(), st.integers() | st.text() | st.none() | numbers))
def test_messages_arrive(content):
    """Values and arrays of all shapes are decoded unchanged."""
    values, arrays = isolation.decode_message(io.BytesIO(isolation.encode_message(content)).read)
    assert values == {name: value for name, value in content.items() if not isinstance(value, np.ndarray)}
    assert set(values | arrays) == set(content)
    for name, array in arrays.items():
        assert array.dtype == content[name].dtype and array.shape == content[name].shape
        np.testing.assert_array_equal(array, content[name])


@pytest.mark.parametrize(("head", "body"), [
    (b"nonsense", b""), (b"[1, []]", b""), (b"[{}, [7]]", b""), (b"[{}, []]", b"\0"), (b'[{"a": NaN}, []]', b""),
    (b'[{"a": "\\ud800"}, []]', b""), (b"[" * 100_000, b""), (b'[{"a": ' + b"[" * 30 + b"]" * 30 + b"}, []]", b""),
    (b'[{}, [["a", "<f8", [2]]]]', b"\0" * 8), (b'[{}, [["a", "<f8", [-1]]]]', b"\0" * 8),
    (b'[{}, [["a", "O", [1]]]]', b"\0" * 8), (b'[{}, [["a", {"a": 1}, [1]]]]', b""),
    (b'[{}, [["a", "<f8", [0, 18446744073709551616]]]]', b""),
    (b'[{}, [["a", "<f8", ' + b"[1" + b", 1" * 80 + b"]]]]", b"\0" * 8),
])
def test_malformed_messages_are_rejected(head, body):
    """Objects and all other dtypes that numpy would parse are rejected."""
    content = io.BytesIO(len(head).to_bytes(8, "little") + len(body).to_bytes(8, "little") + head + body)
    with pytest.raises(ValueError, match="message must"):
        isolation.decode_message(content.read)


@pytest.mark.parametrize("lengths", [(isolation.MAX_HEADER_BYTES + 1, 0), (0, isolation.MAX_ARRAY_BYTES + 1)])
def test_long_messages_are_not_read(lengths):
    """Lengths are checked before anything else is read."""
    readable = iter([struct.pack("<QQ", *lengths)])
    with pytest.raises(ValueError, match="message must have at most"):
        isolation.decode_message(lambda n: next(readable))
