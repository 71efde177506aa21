"""Somebody else's code in a process of its own: it answers as it would here, and reaches nothing that it should not."""

import io
import json
import os
import socket
import sys
import time
from contextlib import contextmanager, suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from eitbench.bench.methods import load_method
from eitbench.bench.sandbox import wall, wire
from eitbench.bench.sandbox.host import Guest, GuestError
from eitbench.bench.sandbox.keeper import Limits
from eitbench.bench.sandbox.wall import landlock_version
from eitbench.data.episodes import simulate
from eitbench.data.recordings import cycle_voltages, recording
from eitbench.data.store import CACHE_VARIABLE
from eitbench.worlds import registry
from eitbench.worlds.catalogue import PIPE_2D
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from short import register_apart
from tiny import FILTER, SCENARIO, write_baseline

KWARGS = json.loads(FILTER.kwargs)
walled = pytest.mark.skipif(not landlock_version(), reason="this kernel has no Landlock")

ATTACKS = '''
import ctypes, fcntl, gc, os, resource, socket, termios
from pathlib import Path
reached = []
def attempt(what, deed):
    try:
        if deed() is not False:
            reached.append(what)
    except (OSError, KeyError):
        pass
def not_negative(result):
    return result >= 0
parent, libc = f"/proc/{HOST}", ctypes.CDLL(None)
other = os.PRIO_PROCESS, HOST
attempt("the cache", lambda: os.listdir(SECRETS))
attempt("a truth", lambda: Path(SECRETS, "secret.txt").read_text())
attempt("the checkout", lambda: Path(ROOT, "README.md").read_text())
attempt("its neighbours", lambda: os.listdir(Path(SECRETS).parent))
attempt("the other's surroundings", lambda: Path(parent, "environ").read_bytes())
attempt("the other's command", lambda: Path(parent, "cmdline").read_bytes())
attempt("the other's memory", lambda: open(parent + "/mem", "rb"))
attempt("the other's files", lambda: os.listdir(parent + "/fd"))
attempt("the other process", lambda: os.kill(HOST, 0))
attempt("the network", lambda: socket.create_connection(("127.0.0.1", PORT), timeout=5))
attempt("UDP", lambda: socket.socket(type=socket.SOCK_DGRAM).sendto(b"the truth", ("127.0.0.1", PORT)))
attempt("a service", lambda: socket.socket(socket.AF_UNIX).connect(SECRETS + "/service"))
attempt("a service by pairs", lambda: socket.socketpair(type=socket.SOCK_DGRAM)[0].sendto(b"x", SECRETS + "/log"))
attempt("the terminal", lambda: any(map(os.isatty, range(64))))
attempt("its keys", lambda: fcntl.ioctl(2, termios.TIOCSTI, b"x"))
attempt("names in the cache", lambda: not_negative(libc.inotify_add_watch(libc.inotify_init(), SECRETS.encode(), 32)))
attempt("names everywhere", lambda: not_negative(libc.fanotify_init(0x600, 0)))
attempt("who may read", lambda: os.chmod(SECRETS + "/secret.txt", 0o644))
attempt("when it was written", lambda: os.utime(SECRETS + "/secret.txt"))
attempt("the other's haste", lambda: os.setpriority(*other, os.getpriority(*other)))
attempt("the other's limits", lambda: resource.prlimit(HOST, resource.RLIMIT_NOFILE))
attempt("the machine's secrets", lambda: open("/etc/shadow"))
attempt("another folder", lambda: Path(SECRETS, "mine.txt").write_text("mine"))
attempt("the name of the cache", lambda: os.environ["EITBENCH_CACHE"] == CACHE)
held = [value for each in gc.get_objects() if type(each) is dict for value in each.values()]
attempt("the truth in memory", lambda: any(type(o).__name__ == "ndarray" and list(o.shape) == SHAPE for o in held))
'''


def simulated(world):
    """(T, L) voltages and currents of an episode."""
    voltages = cycle_voltages(world, 3, recording(world, 3))
    return voltages, world.currents[np.arange(len(voltages)) % len(world.currents)]


@pytest.fixture
def measured():
    """The same of the tiny pipe."""
    return simulated(PIPE_2D.changed(SCENARIO))


@pytest.mark.parametrize("name", ["homogeneous", "mine"])
def test_a_guest_answers_as_it_would_here(name, measured, tmp_path):
    """All that estimators say, of two episodes, to the bit; None where nothing is said."""
    if name == "mine":
        name = write_baseline(tmp_path, update="return None if self.calls < 2 else Estimate(self.level + self.calls, "
                              "self.level**2, voltages, np.outer(voltages, voltages))")
    here = load_method(name, "estimation")
    with Guest("estimation", FILTER.id, KWARGS, name) as guest:
        for _ in range(2):
            guest.begin()
            estimator = here.make(FILTER.make().task)
            for voltages, currents in zip(*measured, strict=True):
                said, expected = guest.update(voltages, currents), estimator.update(voltages, currents)
                assert (said is None) == (expected is None)
                for there, ours in zip(said or (), expected or (), strict=True):
                    np.testing.assert_array_equal(there, ours)
        assert guest.peak_memory > 50e6
        folder, process = guest._private, guest._process
        assert folder.exists()
    assert not folder.exists() and process.poll() is not None


def test_a_policy_plays_as_it_would_here():
    """Actions of a random policy, from the same random numbers."""
    name, kwargs = "eitbench/Pipe2DInjection-v0", {"estimator": "none", "observation": "raw"}
    env = gym.make(name, **kwargs).unwrapped
    observation, _ = env.reset(seed=1)
    here = load_method("random_pair", "injection").make(env.rules, np.random.default_rng(12))
    with Guest("injection", name, kwargs, "random_pair") as guest:
        guest.begin(np.random.default_rng(12))
        said = [guest.act(observation) for _ in range(4)]
        assert said == [here.act(observation) for _ in range(4)] and {type(action) for action in said} == {int}


SCRIPT = {
    "base_of_mine": """
from eitbench.worlds.slugs import OneInEach

class Base(OneInEach):
    pass
""",
    "arrivals_of_mine": """
from dataclasses import dataclass
from base_of_mine import Base

@dataclass(frozen=True)
class Mine(Base):
    interval: float = 0.03
"""}
"""The files of a script whose slugs come otherwise."""


def test_a_guest_is_told_a_script_s_world(tmp_path, monkeypatch):
    """Also where only a part of a part is the script's own, and descends from another file's."""
    id = "mine/Told-v0"
    for name, text in SCRIPT.items():
        (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    register_apart(monkeypatch)
    target = replace(PIPE_2D.target, arrivals=import_module("arrivals_of_mine").Mine())
    world = replace(PIPE_2D.changed(SCENARIO), name="Told", target=target)
    try:
        registry.register(world, id)
        voltages, currents = simulated(world)
        here = load_method("homogeneous", "estimation").make(gym.make(id).unwrapped.task)
        with Guest("estimation", id, {}, "homogeneous") as guest:
            guest.begin()
            for measured in zip(voltages, currents, strict=True):
                said, expected = guest.update(*measured), here.update(*measured)
                np.testing.assert_array_equal(said.mean, expected.mean)
    finally:
        gym.registry.pop(id, None)
        for name in SCRIPT:
            sys.modules.pop(name, None)


@contextmanager
def a_terminal():
    """Within, standard error is one."""
    master, slave, before = *os.openpty(), os.dup(2)
    os.dup2(slave, 2)
    try:
        yield
    finally:
        os.dup2(before, 2)
        for each in (master, slave, before):
            os.close(each)


@walled
def test_it_reaches_nothing(tmp_path, monkeypatch):
    """Neither files nor other processes, sockets, a terminal or a truth, nor which files are opened, whose names hold
    seeds; without the wall the same code does."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    truth = simulate(PIPE_2D.changed(SCENARIO), 3, progress=False).concentration
    here = {"truth": truth, "makes the collector look": []}
    (tmp_path / "secret.txt").write_text("the truth")
    with (socket.create_server(("127.0.0.1", 0)) as server, socket.socket(socket.AF_UNIX) as service,
          socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as log, a_terminal()):
        service.bind(str(tmp_path / "service"))
        service.listen()
        log.bind(str(tmp_path / "log"))
        known = {"SECRETS": str(tmp_path), "HOST": os.getpid(), "PORT": server.getsockname()[1],
                 "CACHE": str(tmp_path / "cache"),
                 "ROOT": str(Path(__file__).parents[2]), "SHAPE": list(here["truth"].shape)}
        source = "\n".join(f"{name} = {value!r}" for name, value in known.items()) + ATTACKS
        within: dict = {}
        exec(source, within)
        assert {"the cache", "a truth", "the checkout", "the other's surroundings", "the other process", "the network",
                "UDP", "a service", "a service by pairs", "the terminal", "names in the cache", "who may read",
                "when it was written", "the other's haste", "the other's limits", "another folder",
                "the name of the cache", "the truth in memory"} <= set(within["reached"])
        curious = write_baseline(tmp_path, init=f"exec({source!r}, globals())",
                                 update="raise RuntimeError(f'reached {reached}')")
        with Guest("estimation", FILTER.id, KWARGS, curious) as guest:
            assert guest.closed
            guest.begin()
            with pytest.raises(GuestError, match=r"^RuntimeError: reached \[\]$"):
                guest.update(np.zeros(4), np.zeros(4))


CHILD = """child = os.fork()
        if not child:
            import time
            for leave in (os.setsid, os.setpgrp):
                try:
                    leave()
                except OSError:
                    pass
            Path.home().joinpath("number").write_text(os.readlink("/proc/self"))
            time.sleep(60)
            os._exit(0)
        while not Path.home().joinpath("number").exists():
            pass
        """


@walled
@pytest.mark.parametrize("end", ["return Estimate(self.level)", "os._exit(1)"])
def test_its_children_end_with_it(end, tmp_path):
    """Also one that would leave its session, and when the guest itself has ended before."""
    with Guest("estimation", FILTER.id, KWARGS, write_baseline(tmp_path, update=CHILD + end)) as guest:
        guest.begin()
        guest._patience = 5.0
        with suppress(GuestError):
            guest.update(np.zeros(4), np.zeros(4))
        child = Path("/proc", (guest._private / "number").read_text(), "status")
    until = time.monotonic() + 5.0
    while child.exists() and "State:\tZ" not in child.read_text():
        assert time.monotonic() < until
        time.sleep(0.05)


def test_a_question_that_is_not_read_is_too_late(tmp_path):
    """A guest may answer in advance and read nothing; the pipe is full some time."""
    ahead = ("from eitbench.bench.sandbox import wire\n        os.write(4, wire.pack({}))\n"
             "        while True: os.write(4, wire.pack({'estimate': None}))")
    with Guest("estimation", FILTER.id, KWARGS, write_baseline(tmp_path, init=ahead)) as guest:
        guest.begin()
        guest._patience, began = 2.0, time.monotonic()
        with pytest.raises(GuestError, match="TimeoutError: a question was not read within 2 s"):
            for _ in range(100):
                guest.update(np.zeros(1000), np.zeros(1000))
        assert not guest.alive and time.monotonic() - began < 20.0


@walled
def test_no_guest_where_the_cache_can_be_read(monkeypatch):
    """As in the folder of Python's packages: truths would lie open."""
    place = Path(np.__file__).parents[1] / "eitbench-test-cache"
    monkeypatch.setenv(CACHE_VARIABLE, str(place))
    with pytest.raises(ValueError, match=r"the cache folder .*eitbench-test-cache lies in .*, which guests may read"):
        Guest("estimation", FILTER.id, KWARGS, "homogeneous")


def test_what_lies_beside_the_package_is_read_unless_it_is_a_checkout(tmp_path, monkeypatch):
    """Dependencies, as `pip install --target` puts them; not records, tests and whatever else a checkout holds."""
    monkeypatch.setattr(wall, "PACKAGE", tmp_path / "eitbench")
    assert tmp_path in wall.python_files()
    (tmp_path / "pyproject.toml").touch()
    assert tmp_path not in wall.python_files() and tmp_path / "eitbench" in wall.python_files()


def test_checkouts_of_others_are_not_read(tmp_path, monkeypatch):
    """What is installed for editing lies on `sys.path`: only what offers something to this package is read."""
    offers, other = tmp_path / "offers", tmp_path / "other"
    for place, name in ((offers, "bench_of_mine"), (other, "secrets_of_mine")):
        (place / "src" / name).mkdir(parents=True)
        (place / "src" / name / "__init__.py").touch()
        monkeypatch.syspath_prepend(place / "src")
    information = offers / "src" / "bench_of_mine-1.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: bench-of-mine\nVersion: 1\n")
    (information / "entry_points.txt").write_text("[eitbench.methods]\nmine = bench_of_mine.mine\n")
    mine = {place for place in wall.python_files() if place.is_relative_to(tmp_path)}
    assert mine == {offers / "src" / "bench_of_mine"}


@pytest.mark.parametrize(("statement", "message"), [
    ("np.ones(2**29)", "MemoryError"), ("os._exit(3)", "ended with status 3"),
    ("os.close(4); __import__('time').sleep(60)", "ended with status -9"), ("raise SystemExit('bye')", "bye"),
    ("__import__('time').sleep(60)", "no answer within 3 s"), ("print('hello')\n        return 7", "or None, got int"),
    ("os.write(4, bytes(2**10))", "ValueError"),
])
def test_what_goes_wrong_is_said(statement, message, tmp_path):
    """Limits of memory and time, a crash, an exit, nonsense on the wire; what it prints is no answer."""
    path = write_baseline(tmp_path, update=statement)
    began = time.monotonic()
    with Guest("estimation", FILTER.id, KWARGS, path, limits=Limits(memory=3 << 30), patience=60) as guest:
        guest.begin()
        guest._patience = 3.0
        with pytest.raises(GuestError, match=message):
            guest.update(np.zeros(4), np.zeros(4))
        assert guest.alive == (message in ("MemoryError", "bye", "or None, got int"))
    assert time.monotonic() - began < 55.0


def test_a_file_that_cannot_be_loaded_is_named(tmp_path):
    """As the error that it would be here."""
    (tmp_path / "mine.py").write_text("class Estimator: pass")
    with pytest.raises(GuestError, match="must define a class Estimator"):
        Guest("estimation", FILTER.id, KWARGS, str(tmp_path / "mine.py"))


numbers = hnp.arrays(st.sampled_from([np.float64, np.float32, np.int64, np.bool_]),
                     hnp.array_shapes(min_dims=0, min_side=0))


@given(st.dictionaries(st.text(), st.integers() | st.text() | st.none()), st.dictionaries(st.text(), numbers))
def test_messages_arrive(words, arrays):
    """Words and arrays, whatever their shape."""
    stream = io.BytesIO(wire.pack(words, arrays))
    said, there = wire.unpack(stream.read)
    assert said == words and set(there) == set(arrays)
    for name, array in arrays.items():
        assert there[name].dtype == array.dtype and there[name].shape == array.shape
        np.testing.assert_array_equal(there[name], array)


@pytest.mark.parametrize(("head", "body"), [
    (b"nonsense", b""), (b"[1, []]", b""), (b'[{}, [["a", "<f8", [2]]]]', b"\0" * 8), (b'[{}, []]', b"\0"),
    (b'[{"a": NaN}, []]', b""), (b'[{"a": "\\ud800"}, []]', b""), (b"[" * 100_000, b""),
    (b'[{}, [["a", "O", [1]]]]', b"\0" * 8), (b'[{}, [["a", "<f8", [-1]]]]', b"\0" * 8),
])
def test_nonsense_is_refused(head, body):
    """Objects above all: unpickled they would be code."""
    content = len(head).to_bytes(8, "little") + len(body).to_bytes(8, "little") + head + body
    stream = iter((content[:16], head, body))
    with pytest.raises(ValueError, match="message"):
        wire.unpack(lambda n: next(stream))
    endless = (2**62).to_bytes(8, "little") * 2
    with pytest.raises(ValueError, match="at most"):
        wire.unpack(lambda n: endless)


@pytest.mark.parametrize("head", [
    b'[{"a": [' + b"[]," * (1 << 24), b"[{}, [" + b"[]," * 300_000, b'[{"a": ' + b"[" * 30 + b"]" * 30 + b"}, []]",
    b'[{"a": 1e999}, []]', b'[{"a": -1e400}, []]', b'[{"a": ' + b"9" * 400 + b"}, []]",
    b'[{"a": 1.' + b"0" * 400 + b"}, []]",
    b'[{}, [["a", "<f8", [0, 18446744073709551616]]]]', b'[{}, [["a", "<f8", [0, true]]]]',
    b'[{}, [["a", "<f8", ' + b"[0" + b", 1" * 60 + b"]]]]", b'[{}, [["a", {"a": 1}, [1]]]]', b'[{}, [7]]', b'[{}, 7]',
])
def test_what_costs_the_host_much_is_refused(head):
    """64 MiB of empty lists took 1.7 GB and 21 s; what is too long is not even read."""
    asked, began = [], time.process_time()
    stream = iter(((len(head).to_bytes(8, "little") + bytes(8)), head, b""))

    def read(n):
        asked.append(n)
        return next(stream)

    with pytest.raises(ValueError, match="message must"):
        wire.unpack(read)
    assert time.process_time() - began < 0.5 and sum(asked) <= 16 + wire.HEAD


def test_the_variables_of_this_process_stay_here():
    """A guest sees none of them but those it needs."""
    os.environ["EITBENCH_TEST_SECRET"] = "salt"
    try:
        with Guest("estimation", FILTER.id, KWARGS, "homogeneous") as guest:
            seen = Path(f"/proc/{guest.process}/environ").read_text()
    finally:
        del os.environ["EITBENCH_TEST_SECRET"]
    assert "SECRET" not in seen and "NUMBA_CACHE_DIR" in seen
