"""The table of episodes in the package has the same scores as the records."""

import lzma
import re

import pandas as pd
import pytest
from eitbench._files import bundled_path
from eitbench.bench import load, records
from eitbench.bench.episode_table import TABLE_NAME, episode_table, read_episode_table, write_episode_table
from eitbench.bench.records import split_outdated, write_record
from eitbench.report.boards import anchors, bundled_anchors

from tiny import several_boards

RESULTS = bundled_path("leaderboards") / "results"


def test_the_published_table_agrees_with_the_records(published, monkeypatch):
    """`eitbench leaderboard --records leaderboards/results` would not change it, and `load` returns the same data, with
    five digits, and three of the times. Records name no folder of a machine."""
    texts = [path.read_text(encoding="utf-8") for path in RESULTS.glob("*.json")]
    assert len(texts) >= 319 and not any(re.search(r'[ "=](/|~|[A-Z]:\\)\w|\.\./', text) for text in texts)
    text = lzma.decompress((RESULTS.parent / TABLE_NAME).read_bytes()).decode()
    assert text == episode_table(published), "run `eitbench leaderboard --records leaderboards/results`"
    shipped = load(RESULTS.parent / "none")
    monkeypatch.setattr(records, "read_records", {RESULTS: published}.get)
    full = load()
    pd.testing.assert_frame_equal(shipped, full, check_exact=False, rtol=5e-3, atol=0.0)
    times = full["metric"] == "seconds_per_step"
    pd.testing.assert_frame_equal(shipped[~times], full[~times], check_exact=False, rtol=6e-5, atol=0.0)
    exact = anchors(published)
    assert bundled_anchors() == {key: pytest.approx(errors, rel=6e-5) for key, errors in exact.items()}


def test_records_come_back(tmp_path):
    """The table preserves naive baselines, failures, unusual names and missing scores."""
    written = several_boards()
    write_episode_table(written, tmp_path / TABLE_NAME)
    read = read_episode_table(tmp_path / TABLE_NAME)
    assert [each["method"] for each in read] == [each["method"] for each in written]
    for made, found in zip(written, read, strict=True):
        assert all(found[name] == made[name] for name in found if name != "episodes")
        for one, other in zip(made["episodes"], found["episodes"], strict=True):
            assert all(other[name] == one[name] for name in other if name != "scores")
            assert ("scores" in one) == ("scores" in other)
            known = {name: value for name, value in one.get("scores", {}).items() if value is not None}
            assert other.get("scores", {}) == pytest.approx(known, rel=6e-5)
    assert [len(group) for group in split_outdated(read)] == [len(group) for group in split_outdated(written)]
    for each in written:
        write_record(tmp_path / "json", each)
    listed, order = load(tmp_path / "results"), ["environment", "method", "version", "seed", "metric"]
    pd.testing.assert_frame_equal(listed.sort_values(order, ignore_index=True),
                                  load(tmp_path / "json").sort_values(order, ignore_index=True), rtol=6e-5)


@pytest.mark.parametrize("damage", [
    lambda data: data[:-9], lambda data: b"no lzma", lambda data: lzma.compress(b"a\n1\n"),
    lambda data: lzma.compress(lzma.decompress(data)[:-3] + b"x,y\n")])
def test_a_damaged_table_is_named(damage, tmp_path):
    write_episode_table(several_boards(), tmp_path / TABLE_NAME)
    (tmp_path / TABLE_NAME).write_bytes(damage((tmp_path / TABLE_NAME).read_bytes()))
    with pytest.raises(ValueError, match=rf"table of episodes .*{TABLE_NAME} cannot be read"):
        load(tmp_path / "results")
