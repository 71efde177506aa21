"""What a guest does wrong costs its own result, and nobody else's."""

import json
import os
import tempfile
from pathlib import Path

import pytest
from eitbench.bench import run
from eitbench.bench.run import Job, run_episode, run_jobs
from eitbench.bench.sandbox import guests, keeper
from eitbench.bench.sandbox.host import Guest
from eitbench.bench.store import EpisodeStore, machine, provenance
from eitbench.data.store import CACHE_VARIABLE, folder
from eitbench.worlds.catalogue import PIPE_2D

from tiny import FILTER, SCENARIO, write_baseline


@pytest.fixture(autouse=True)
def cache(run_cache, monkeypatch):
    """One cache of episodes for all tests of this session, and no guest left behind."""
    monkeypatch.setenv(CACHE_VARIABLE, run_cache)
    yield
    guests.close()


DEEP = """here = os.open(Path.home(), os.O_RDONLY)
        for _ in range(1500):
            os.mkdir("d", 0o700, dir_fd=here)
            below = os.open("d", os.O_RDONLY, dir_fd=here)
            os.close(here)
            here = below
        os.close(os.open("file", os.O_CREAT, dir_fd=here))
        for name in (b"closed", b"\\xff\\n"):
            os.makedirs(os.fsencode(Path.home()) + b"/" + name + b"/inner")
        os.symlink(LINKED, Path.home() / "link")
        os.mkdir(Path.home() / "kept", 0)"""
FAULTS = {
    "folders": DEEP,
    "name": "__import__('ctypes').CDLL(None).prctl(15, b'\\xff\\xfe', 0, 0, 0)",
    "huge": "self.level = self.level * 1e300",
    "beyond": "self.level = self.level.astype(np.longdouble) * np.longdouble(10) ** 4000",
    "half": "self.level = self.level.astype(np.float16) * np.float16(1e4)",
    "words": "os.write(4, __import__('eitbench.bench.sandbox.wire').bench.sandbox.wire.pack({'a': 1}) * 99)",
    "lists": "os.write(4, (1 << 26).to_bytes(8, 'little') + bytes(8) + b'[[' + b'[],' * (1 << 22))",
    "gone": "os.kill(os.getpid(), 9), os._exit(3)",
}
"""Name -> what its first update does."""


def test_what_cannot_be_made_leaves_no_folder_behind(tmp_path, monkeypatch):
    """A world that there is not is refused before any process is started."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    with pytest.raises(ValueError, match="flow has no 'viscose'"):
        Guest("estimation", FILTER.id, {"world": {"flow": {"viscose": 1}}}, write_baseline(tmp_path))
    assert list((tmp_path / "temporary").iterdir()) == []


def test_the_honest_method_beside_them_gets_its_episodes(tmp_path, monkeypatch):
    """Strangers that do all sorts of things play first; their results say so, and the run goes on."""
    beside = tmp_path / "mine"
    beside.mkdir()
    (beside / "precious").write_text("mine")
    paths = [write_baseline(tmp_path, name, update=f"{fault.replace('LINKED', repr(str(beside)))}\n"
                            "        return Estimate(self.level)") for name, fault in FAULTS.items()]
    paths.append(write_baseline(tmp_path, "honest"))
    folders = tmp_path / "temporary"
    folders.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folders))
    store = EpisodeStore(tmp_path / "results")
    run_jobs([Job(FILTER, path, 1, True) for path in paths], store)
    results = list(store.results())
    assert len(results) == len(paths)
    status = {result["method"]: result["status"] for result in results}
    assert status["honest"] == status["name"] == "ok" and status["gone"] == status["huge"] == "failed"
    assert status["lists"] == status["beyond"] == "failed"
    assert "honest" in {record["method"] for record in store.write_records()}
    assert (beside / "precious").read_text() == "mine"
    assert not list(folders.iterdir())


def test_whatever_lies_in_a_folder_it_is_removed(tmp_path):
    """Deeper than any path may be, unreadable, with odd names; what links lead to stays."""
    (tmp_path / "precious").write_text("mine")
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    here = os.open(theirs, os.O_RDONLY)
    for _ in range(1500):
        os.mkdir("d", dir_fd=here)
        below = os.open("d", os.O_RDONLY, dir_fd=here)
        os.close(here)
        here = below
    os.close(here)
    for mode, name in ((0, b"closed"), (0o500, b"\xff\n")):
        place = os.fsencode(theirs) + b"/" + name
        os.makedirs(place + b"/inner")
        os.mkfifo(place + b"/pipe")
        os.chmod(place, mode)
    (theirs / "link").symlink_to(tmp_path)
    (theirs / "closed").chmod(0)
    keeper.remove(str(theirs))
    assert [path.name for path in tmp_path.iterdir()] == ["precious"]
    keeper.remove(str(theirs))                                          # and nothing is said if it is not there


def test_a_file_that_can_no_longer_be_loaded_fails_alone(tmp_path):
    """In the midst of a run, when others have been played already."""
    path = write_baseline(tmp_path)
    job = Job(FILTER, path, 1, True)
    beginning = run._beginning(job, job.load())
    Path(path).write_text("import os; os._exit(4)")
    store = EpisodeStore(tmp_path / "results")
    how = {"command": "", **provenance(), "machine": machine()}
    run._run_job(job, store, how, "", beginning)
    (result,) = store.results()
    assert result["status"] == "failed" and "ended with status 4" in result["message"] and result["method"] == "mine"


def test_folders_in_the_place_of_files_are_no_obstacle(tmp_path, monkeypatch):
    """In the cache: what lies there is made again, each time, with a warning."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    there = folder(PIPE_2D.changed(SCENARIO))
    assert run_episode(Job(FILTER, "homogeneous", 1))[0]["status"] == "ok"
    kept = [path.name for path in there.iterdir()]
    assert kept
    for name in {*kept, "outline.npz", "region.npz", "reduced-1.npz", "joint-1.npz", "2.npy", "2.truth.npz"}:
        (there / name).unlink(missing_ok=True)
        (there / name).mkdir()
    path = write_baseline(tmp_path)
    with pytest.warns(UserWarning, match="cannot be kept"):
        results = [run_episode(Job(FILTER, path, seed, True))[0] for seed in (1, 2)]
    assert [result["status"] for result in results] == ["ok", "ok"]
    assert json.dumps(results)
