"""Who waits is told for what, once, and only if it is long; without a terminal the logger is told."""

import logging

import pytest
from eitbench import _notice
from eitbench._notice import Wait
from eitbench.numerics import compiled


@pytest.fixture
def clock(monkeypatch):
    """A clock that shows what it is set to."""
    now = [0.0]
    monkeypatch.setattr(_notice.time, "monotonic", lambda: now[0])
    return now


@pytest.mark.parametrize(("seconds_a_step", "said"), [(0.1, 1), (0.01, 0)])
def test_what_is_long_is_said_once(seconds_a_step, said, clock, caplog):
    caplog.set_level(logging.INFO, "eitbench")
    wait = Wait("making it", 100, "a command does so beforehand")
    for _ in range(100):
        clock[0] += seconds_a_step
        wait.tick(1)
    assert [record.getMessage() for record in caplog.records] == said * [
        "making it, 10 s or less; a command does so beforehand"]


def test_a_terminal_is_told_there(monkeypatch, capsys, caplog):
    caplog.set_level(logging.INFO, "eitbench")
    monkeypatch.setattr(_notice.sys.stderr, "isatty", lambda: True, raising=False)
    _notice.say("hello")
    assert capsys.readouterr().err == "eitbench: hello\n" and not caplog.records


def test_kernels_that_are_not_compiled_yet_are_told_of(tmp_path, monkeypatch, caplog):
    caplog.set_level(logging.INFO, "eitbench")
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    place = tmp_path / "__pycache__"
    place.mkdir()
    tell = compiled._tell_of_compiling.__wrapped__
    tell(place)
    assert "20 s" in caplog.text and "eitbench bank" in caplog.text
    caplog.clear()
    (place / "kernels.solve_lu-373.py311.nbi").touch()
    tell(place)
    assert not caplog.text
