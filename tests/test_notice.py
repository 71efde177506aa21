"""A notice of a slow task appears once, only for long tasks; without a terminal it goes to the logger."""

import logging

import pytest
from eitbench import _notice
from eitbench._notice import SlowTaskNotice


@pytest.mark.parametrize(("seconds_a_step", "said"), [(0.1, 1), (0.01, 0)])
def test_long_tasks_are_reported_once(seconds_a_step, said, monkeypatch, caplog):
    caplog.set_level(logging.INFO, "eitbench")
    clock = [0.0]
    monkeypatch.setattr(_notice.time, "monotonic", lambda: clock[0])
    wait = SlowTaskNotice("making it", 100, "a command does so beforehand")
    for _ in range(100):
        clock[0] += seconds_a_step
        wait.tick(1)
    assert [record.getMessage() for record in caplog.records] == said * [
        "making it, 10 s or less; a command does so beforehand"]


def test_a_notice_is_printed_in_a_terminal(monkeypatch, capsys, caplog):
    caplog.set_level(logging.INFO, "eitbench")
    monkeypatch.setattr(_notice.sys.stderr, "isatty", lambda: True, raising=False)
    _notice.notify("hello")
    assert capsys.readouterr().err == "eitbench: hello\n" and not caplog.records
