"""More attacks of a guest, on what lies around it, on its host and on who plays beside it."""

import json
import struct
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import typer
from eitbench.bench import held_out, run
from eitbench.bench.run import Job
from eitbench.bench.sandbox import guests, host, keeper, wire
from eitbench.bench.sandbox.host import Guest, GuestError
from eitbench.bench.sandbox.wall import landlock_version
from eitbench.bench.store import EpisodeStore, machine, provenance
from eitbench.cli.options import clear_errors
from eitbench.data.store import CACHE_VARIABLE

from recorded import forget_made
from tiny import FILTER, record, without_namespaces, write_baseline

KWARGS = json.loads(FILTER.kwargs)
walled = pytest.mark.skipif(not landlock_version(), reason="this kernel has no Landlock")


@pytest.fixture(autouse=True)
def cache(run_cache, monkeypatch):
    """One cache of episodes for all tests of this session, and no guest left behind."""
    monkeypatch.setenv(CACHE_VARIABLE, run_cache)
    yield
    guests.close()


ATTACKS = '''
import os, signal, stat, subprocess, sys
import numpy
from pathlib import Path
reached = []
home = Path(HOME or Path.home())
def attempt(what, deed):
    try:
        if deed() is not False:
            reached.append(what)
    except OSError:
        pass
def removed(path):
    os.unlink(path)
attempt("an open file", lambda: bool([n for n in os.listdir("/proc/self/fd") if os.path.exists(f"/proc/self/fd/{n}")
        and stat.S_ISREG(os.stat(f"/proc/self/fd/{n}").st_mode)]))
mine = Path(PACKAGE, "mine.tmp")
attempt("a file beside ours", lambda: mine.touch() or removed(mine))
attempt("a kernel", lambda: Path(PACKAGE, "numerics", "__pycache__", "x.nbi").write_bytes(b"") or removed(
    Path(PACKAGE, "numerics", "__pycache__", "x.nbi")))
attempt("the start of every Python", lambda: Path(SITE, "mine.pth").touch() or removed(Path(SITE, "mine.pth")))
attempt("a second name of ours", lambda: os.link(Path(PACKAGE, "scoring.py"), home / "x") or removed(home / "x"))
attempt("ours by a link", lambda: os.symlink(Path(PACKAGE, "scoring.py"), home / "y") or os.close(
    os.open(home / "y", os.O_RDWR)))
attempt("ours opened again", lambda: os.close(os.open(
    f"/proc/self/fd/{os.open(Path(PACKAGE, 'scoring.py'), os.O_RDONLY)}", os.O_RDWR)))
attempt("shared memory", lambda: open("/dev/shm/eitbench-mine", "w").close() or removed("/dev/shm/eitbench-mine"))
attempt("other temporary files", lambda: (home.parent / "mine").touch() or removed(home.parent / "mine"))
'''


@walled
def test_more_that_it_does_not_reach(tmp_path):
    """Nothing by which the next guest, or this process, would run its code; here the same code reaches it."""
    like_ours, home = tmp_path / "package", tmp_path / "home"
    (like_ours / "numerics" / "__pycache__").mkdir(parents=True)
    (like_ours / "scoring.py").touch()
    home.mkdir()
    within: dict = {}
    with (like_ours / "scoring.py").open():
        exec(f"PACKAGE, SITE, HOME = {str(like_ours)!r}, {str(tmp_path)!r}, {str(home)!r}\n{ATTACKS}", within)
    assert len(within["reached"]) == 9
    package, site = Path(wire.__file__).parents[2], Path(np.__file__).parents[1]
    source = f"PACKAGE, SITE, HOME = {str(package)!r}, {str(site)!r}, None\n{ATTACKS}"
    path = write_baseline(tmp_path, init=f"exec({source!r}, globals())",
                          update="raise RuntimeError(f'reached {reached}')")
    with Guest("estimation", FILTER.id, KWARGS, path) as guest:
        guest.begin()
        with pytest.raises(GuestError, match=r"^RuntimeError: reached \[\]$"):
            guest.update(np.zeros(4), np.zeros(4))


def test_who_stops_itself_is_too_late(tmp_path, monkeypatch):
    """It is ended all the same; in a namespace of its own it cannot even stop."""
    monkeypatch.setattr(keeper, "__file__", without_namespaces(tmp_path))
    with Guest("estimation", FILTER.id, KWARGS, write_baseline(tmp_path, update="os.kill(0, 19)")) as guest:
        guest.begin()
        guest._patience = 2.0
        with pytest.raises(GuestError):
            guest.update(np.zeros(4), np.zeros(4))
            guest.update(np.zeros(4), np.zeros(4))
        folder = guest._private
    assert not folder.exists()


def test_all_answers_together_have_an_end(tmp_path, monkeypatch):
    """Or each would take as long as one may; a new episode has its own time."""
    with Guest("estimation", FILTER.id, KWARGS, write_baseline(tmp_path, update="""__import__("time").sleep(0.2)
        return Estimate(self.level)""")) as guest:
        monkeypatch.setattr(host, "ENDURANCE", 60.0)
        guest.begin()
        guest._left = 0.1
        guest.begin()
        guest.update(np.zeros(4), np.zeros(4))
        guest._left = 0.1
        with pytest.raises(GuestError, match="TimeoutError: its answers in one episode took more than 60 s"):
            guest.update(np.zeros(4), np.zeros(4))
        assert not guest.alive


@pytest.mark.parametrize("kind", [",f8", "9999f8", "f8,f8", "<f8\0", "O", "S0", "M8[s]", "V8", "<c16", "f",
                                  "\u0661f8", "<f999"])
def test_types_are_numbers(kind):
    """numpy parses some texts as a program would be."""
    head = json.dumps([{}, [["mean", kind, [1]]]]).encode()
    parts = iter((struct.pack("<QQ", len(head), 16), head, bytes(16)))
    with pytest.raises(ValueError, match="message must"):
        wire.unpack(lambda n: next(parts))


def test_true_is_one():
    """Other bytes would be true and false at once."""
    head = json.dumps([{}, [["mean", "|b1", [2]]]]).encode()
    for content, fits in ((b"\x00\x01", True), (b"\x00\xff", False)):
        parts = iter((struct.pack("<QQ", len(head), 2), head, content))
        if fits:
            assert wire.unpack(lambda n, parts=parts: next(parts))[1]["mean"].tolist() == [False, True]
        else:
            with pytest.raises(ValueError, match="true and false only"):
                wire.unpack(lambda n, parts=parts: next(parts))


def test_a_type_that_cannot_be_parsed_is_the_file_s(tmp_path):
    """Also where it is said before anything is played: ``SyntaxError`` ended the whole run."""
    path = tmp_path / "mine.py"
    head = b'[{}, [["a", ",f8", [1]]]]'
    path.write_text(f"import os\nos.write(4, {struct.pack('<QQ', len(head), 8) + head + bytes(8)!r})\n")
    with pytest.raises(ValueError, match=r"mine.py cannot be played: ValueError: a message must"):
        Job(FILTER, str(path), 1, True).load()


@pytest.mark.parametrize(("changes", "message"), [
    ({"name": "x\0"}, "no control characters"), ({"name": "x" * 5000}, "100 letters at most"),
    ({"name": "Kalman_Filter"}, "must not look like one of ours"), ({"title": "\u2800"}, "can be seen")])
def test_names_that_are_no_files_are_refused_before(changes, message, tmp_path, monkeypatch):
    """An agent calls itself; a run that cannot keep a result ended with all others'."""
    agent = tmp_path / "model.zip"
    agent.write_bytes(b"")
    about = {"name": "mine", "title": "Mine", "boards": ["filter"], "parameters": {}, "role": None, "suits": True}
    forget_made(guests)
    monkeypatch.setattr(guests, "_enter", lambda *_: SimpleNamespace(about=about | changes))
    try:
        with pytest.raises(ValueError, match=f"model.zip cannot have a record: .*{message}"):
            guests._load("estimation", FILTER.id, FILTER.kwargs, str(agent), agent, "0" * 64)
    finally:
        forget_made(guests)


def test_who_changes_its_name_writes_over_nobody_s_results(tmp_path):
    """What it says of itself in another process is compared with what it said before."""
    path = Path(write_baseline(tmp_path))
    path.write_text(path.read_text().replace("parameters = {}", "parameters = {'a': os.getpid() * 0 + id(object())}"))
    job = Job(FILTER, str(path), 1, True)
    beginning = run._beginning(job, job.load()) | {"title": "What it was before"}
    store = EpisodeStore(tmp_path / "results")
    run._run_job(job, store, {"command": "", **provenance(), "machine": machine()}, "", beginning)
    (result,) = store.results()
    assert result["status"] == "failed" and "says other things of itself than before" in result["message"]
    assert result["title"] == "What it was before" and "scores" not in result


def test_a_stranger_s_words_move_no_cursor(capsys):
    """`eitbench render` has no result to put them into; a traceback would show them as they are."""
    with pytest.raises(typer.Exit), clear_errors():
        raise GuestError("RuntimeError: \x1b]0;mine\x07\u202e")
    assert capsys.readouterr().err == "RuntimeError: \\x1b]0;mine\\x07\\u202e\n"
    with pytest.raises(RuntimeError, match="another"), clear_errors():
        raise RuntimeError("another")


def test_a_file_put_in_another_s_place_is_noticed_held_out(tmp_path, monkeypatch):
    """Between the look at its sha256 and the first held-out episode."""
    def played(job):
        return {"status": "ok", "scores": {"error": 0.1}, "method_sha256": "0" * 64}, {}

    monkeypatch.setattr(held_out, "run_episode", played)
    made = record("mine", [0.1] * 8)
    job = Job(FILTER, write_baseline(tmp_path), 1, True)
    monkeypatch.setattr(Job, "isolation", "landlock")
    found = held_out.held_out(made, held_out.plays(made, job, bytes(32), 4))[1]
    assert found == [f"the file that played has the sha256 {'0' * 64}, that of the record has {made['method_sha256']}"]
