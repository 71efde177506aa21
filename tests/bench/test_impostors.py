"""Records that pose as what they are not: names that look alike, keys said twice, floors of their own."""

import json
import os

import pytest
from eitbench.bench.methods import MOST_BYTES, find_method
from eitbench.bench.records import file_name, read_record, sealed
from eitbench.report.boards import boards, run_boards
from eitbench.report.site import collect, render

from tiny import record

FLOOR = [0.20, 0.24, 0.22, 0.26, 0.18, 0.30, 0.25, 0.21]


def put(folder, made, name=None, text=None):
    """Written as somebody else would."""
    path = folder / (name or file_name(made))
    path.write_text(text or json.dumps(made), encoding="utf-8")
    return path


@pytest.mark.parametrize("field", ["checkpoint_sha256", "version", "method_sha256"])
def test_a_pattern_ends_where_the_text_does(field, tmp_path):
    """Python's $ also stands before a last newline."""
    made = record("mine", FLOOR)
    made = sealed(made | {field: (made[field] or "a" * 64) + "\n"})
    with pytest.raises(ValueError, match="is not valid"):
        read_record(put(tmp_path, made, name=file_name(made).replace("\n", "\\n")))


def test_a_file_of_the_floor_s_name_is_no_floor():
    """Nor an anchor of the skill: only versions are ours."""
    theirs, mine = record("homogeneous", [9.0] * 8, version="1"), record("mine", FLOOR)
    best = record("true_model_smoother", [0.1] * 8, role="reference")
    assert boards([theirs, mine])["gain"].isna().all()
    assert all(row.cells["skill"] is None for board in run_boards([theirs, mine, best]) for row in board.rows)


def test_a_csv_holds_no_formula():
    """What begins like one is text in the programs that open it."""
    made = record("=HYPERLINK(\"x\")", FLOOR, title="@SUM(1)")
    line = render(collect([made]))["leaderboard.csv"].splitlines()[1]
    assert "'=HYPERLINK" in line and ",'@SUM(1)," in line


def test_a_method_s_file_is_not_too_large_to_be_read(tmp_path):
    """Here it costs nothing: it has a hole."""
    path = tmp_path / "mine.py"
    path.touch()
    os.truncate(path, MOST_BYTES + 1)
    with pytest.raises(ValueError, match="must have 256 MiB at most"):
        find_method(str(path), "estimation")
