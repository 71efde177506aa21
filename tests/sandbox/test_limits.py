"""What a guest may take of the machine, with all that it has started: who takes more ends, and says of what."""

import json
import tempfile
from pathlib import Path

import numpy as np
import pytest
from eitbench.bench.run import Job, run_jobs
from eitbench.bench.sandbox import guests, keeper
from eitbench.bench.sandbox.host import Guest, GuestError
from eitbench.bench.sandbox.keeper import Limits
from eitbench.bench.store import EpisodeStore
from eitbench.data.store import CACHE_VARIABLE

from tiny import FILTER, without_namespaces, write_baseline

KWARGS = json.loads(FILTER.kwargs)
SMALL = Limits(tasks=60, disk=100 << 20, files=2_000)
pytestmark = pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="only Linux is asked who has started what")

WAIT = "\n        __import__('time').sleep(60)"
EXCESSES = {
    "processes": (r"more than 60 processes and threads|BlockingIOError", """for _ in range(200):
            if not os.fork():
                __import__("time").sleep(60)
                os._exit(0)"""),
    "threads": (r"more than 60 processes and threads|can't start new thread", """import threading, time
        for _ in range(200):
            threading.Thread(target=time.sleep, args=(60,), daemon=True).start()"""),
    "many large files": (r"files of more than 100 MiB", """for k in range(6):
            (Path.home() / str(k)).write_bytes(bytes(40 << 20))"""),
    "removed files": (r"files of more than 100 MiB", """kept = [open(Path.home() / str(k), "wb") for k in range(6)]
        for file in kept:
            os.unlink(file.name)
            file.write(bytes(40 << 20))
            file.flush()"""),
    "files": (r"more than 2000 files", """for k in range(4000):
            (Path.home() / str(k)).touch()"""),
    "hidden files": (r"more than 2000 files", """os.mkdir(Path.home() / "hidden", 0o300)
        for k in range(4000):
            (Path.home() / "hidden" / str(k)).touch()"""),
    "folders": (r"more than 64 folders within each other", """here = os.open(Path.home(), os.O_RDONLY)
        for _ in range(1500):
            os.mkdir("d", 0o700, dir_fd=here)
            here, above = os.open("d", os.O_RDONLY, dir_fd=here), here
            os.close(above)"""),
    "memory of many": (r"more than \d+ MiB of memory", """for _ in range(8):
            if not os.fork():
                held = np.ones(25 << 20)
                __import__("time").sleep(60)
                os._exit(0)"""),
}
"""Name -> what is said, and what its update does; each takes a few times what it may, no more."""


@pytest.mark.parametrize(("what", "granted"), [
    *((what, True) for what in EXCESSES), ("processes", False), ("memory of many", False), ("hidden files", False)])
def test_too_much_is_said_and_ended(what, granted, tmp_path, monkeypatch):
    """The guest is gone with all that it has started, and its folder too."""
    message, statement = EXCESSES[what]
    if not granted:
        monkeypatch.setattr(keeper, "__file__", without_namespaces(tmp_path))
    limits = SMALL._replace(memory=1200 << 20) if what == "memory of many" else SMALL
    path = write_baseline(tmp_path, update=statement + WAIT)
    with Guest("estimation", FILTER.id, KWARGS, path, limits=limits) as guest:
        assert granted or "pid" not in guest.walls
        guest.begin()
        with pytest.raises(GuestError, match=message):
            guest.update(np.zeros(4), np.zeros(4))
        folder = guest._private
    assert not folder.exists()


def test_a_file_ends_where_it_may(tmp_path):
    """Also one of holes only; the guest is told and lives."""
    path = write_baseline(tmp_path, update="""
        with open(Path.home() / "large", "wb") as file:
            os.truncate(file.fileno(), 3 << 30)""")
    with Guest("estimation", FILTER.id, KWARGS, path, limits=SMALL) as guest:
        guest.begin()
        with pytest.raises(GuestError, match=r"OSError: .*File too large"):
            guest.update(np.zeros(4), np.zeros(4))
        assert guest.alive


MODEST = """import joblib, subprocess, time
subprocess.run(["true"], check=True)
assert joblib.Parallel(4, backend="threading")(joblib.delayed(abs)(-k) for k in range(8)) == list(range(8))
for k in range(300):
    (Path.home() / str(k)).write_bytes(bytes(1 << 20))
for _ in range(100):
    if not (child := os.fork()):
        os._exit(0)
    os.waitpid(child, 0)
for _ in range(20):
    if not os.fork():
        time.sleep(1.0)
        os._exit(0)
time.sleep(1.5)
"""


def test_what_is_modest_is_not_too_much(tmp_path):
    """Twenty processes that share their memory, one after the other a hundred, some hundred megabytes of files."""
    path = write_baseline(tmp_path, update=f"exec({MODEST!r}, globals())\n        return Estimate(self.level)")
    with Guest("estimation", FILTER.id, KWARGS, path) as guest:
        guest.begin()
        assert guest.update(np.zeros(4), np.zeros(4)).mean[0] == 29.0


ORPHANS = """for _ in range(80):
            if not (child := os.fork()):
                if os.fork():
                    os._exit(0)
                os._exit(0)
            os.waitpid(child, 0)
        __import__("time").sleep(1.0)
        return Estimate(self.level)"""


def test_orphans_are_let_go(tmp_path, monkeypatch):
    """Of a guest without a namespace; else they stay in the table of processes, and count."""
    monkeypatch.setattr(keeper, "__file__", without_namespaces(tmp_path))
    path = write_baseline(tmp_path, update=ORPHANS)
    with Guest("estimation", FILTER.id, KWARGS, path, limits=SMALL) as guest:
        guest.begin()
        guest.update(np.zeros(4), np.zeros(4))
        number = guest._process.pid
        assert len(Path(f"/proc/{number}/task/{number}/children").read_text().split()) < 60


def test_only_its_own_result_fails(run_cache, tmp_path, monkeypatch):
    """The honest method beside it plays on, and nothing is left."""
    monkeypatch.setenv(CACHE_VARIABLE, run_cache)
    monkeypatch.setattr(guests, "Guest", lambda *given: Guest(*given, limits=SMALL))
    folders = tmp_path / "temporary"
    folders.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folders))
    paths = [write_baseline(tmp_path, "greedy", update=EXCESSES["files"][1] + WAIT), write_baseline(tmp_path, "honest")]
    store = EpisodeStore(tmp_path / "results")
    run_jobs([Job(FILTER, path, 1, True) for path in paths], store)
    status = {result["method"]: (result["status"], result.get("message")) for result in store.results()}
    assert status == {"honest": ("ok", None), "greedy": (
        "failed", "ResourceLimitError: it took more than 2000 files")}
    assert not list(folders.iterdir())
