"""Leaderboards: ranks and means computed by hand; table, CSV and Markdown agree and are up to date."""

import io
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from eitbench.bench import load
from eitbench.bench.records import read_records, write_record
from eitbench.bench.statistics import interquartile_mean, stratified_bootstrap
from eitbench.bench.tracks import environment_name
from eitbench.report.boards import ALL
from eitbench.report.site import collect, render
from eitbench.report.tables import BADGES

from tiny import BOARD_IDS, RUN, boards, record, sha

ROOT = Path(__file__).parents[2]
FLOOR = [0.20, 0.24, 0.22, 0.26, 0.18, 0.30, 0.25, 0.21]
TANK = "eitbench/RotatingTank2D-v0"


def times(factor, errors=FLOOR):
    """Return errors of a method that is better by a constant factor in every episode."""
    return [factor * error for error in errors]


def gaining(gains):
    """Return errors of a method with these skill scores."""
    return [floor * (1 - gain) for floor, gain in zip(FLOOR, gains, strict=True)]


def floor(**changes):
    return record("homogeneous", FLOOR, role="floor", **changes)


def table_of(*records):
    return boards(list(records)).set_index("method")


def test_ranks_and_means_by_hand():
    """a halves the naive error in each episode, b nearly so, c is worse: ranks 1, 2 and 3; the baseline has no rank."""
    table = table_of(floor(), record("c", times(0.8)), record("a", times(0.5)), record("b", times(0.51)))
    assert list(table.index) == ["a", "b", "c", "homogeneous"]
    assert list(table["rank"][:3]) == [1, 2, 3] and table["rank"].isna()["homogeneous"]
    assert list(table["note"]) == ["", "", "", "floor"]
    assert table["error"]["homogeneous"] == pytest.approx(0.2325) and table["error"]["a"] == pytest.approx(0.11625)
    assert table["gain"]["a"] == pytest.approx(0.5) and table["gain"]["homogeneous"] == 0.0
    assert table["gain_low"]["a"] == pytest.approx(0.5) == table["gain_high"]["a"]      # equal in each episode
    value, low, high = stratified_bootstrap({"x": FLOOR}, lambda x: x.mean(axis=-1))
    assert tuple(table.loc["homogeneous", ["error", "error_low", "error_high"]]) == pytest.approx((value, low, high))


def test_few_episodes_have_no_interval():
    """Five episodes are too few for an interval; then all methods are tied."""
    table = table_of(record("homogeneous", FLOOR[:5], role="floor"), record("a", times(0.1, FLOOR[:5])),
                     record("b", times(0.9, FLOOR[:5])))
    assert table[["error_low", "error_high", "gain_low", "gain_high"]].isna().all(axis=None)
    assert list(table["rank"][:2]) == [1, 1]
    assert "0.22" in render(collect([record("homogeneous", FLOOR[:5], role="floor")]))["leaderboard.md"]


def test_who_has_no_rank():
    """Naive baselines, oracles, privileged methods, and methods with failed or missing episodes are listed only."""
    table = table_of(floor(), record("reference", times(0.01), role="reference"),
                     record("seer", times(0.02), privileged=True, role="reference"), record("all", times(0.9)),
                     record("failing", [*times(0.1)[:7], None]), record("few", times(0.1)[:7]))
    assert dict(table["note"]) == {"homogeneous": "floor", "reference": "reference", "seer": "reference, privileged",
                                   "failing": "1 failed", "few": "1 missing", "all": ""}
    assert dict(table["rank"].dropna()) == {"all": 1}
    assert list(table.index) == ["reference", "seer", "all", "homogeneous", "failing", "few"]
    assert table["error"]["failing"] == pytest.approx(np.mean(times(0.1)[:7]))


def test_episodes_are_those_of_the_naive_baseline():
    """More seeds than the naive baseline's change neither means nor completeness; a failure among them does."""
    more = {f"test:{i}": error for i, error in enumerate([*times(0.5), 9.0, 9.0])}
    table = table_of(floor(), record("a", more), record("b", times(0.6)), record("c", more | {"test:9": None}),
                     record("elsewhere", {"test:50": 0.001}))
    assert table["error"]["a"] == pytest.approx(0.11625) and dict(table["rank"].dropna()) == {"a": 1, "b": 2}
    assert table["note"]["c"] == "1 failed" and set(table["seeds"]) == {"test:0-7"} and "elsewhere" not in table.index


def test_aggregate_of_a_class():
    """Methods that are complete in all environments are ranked by the pooled interquartile mean of skill scores."""
    pipe, tank = [0.5 + 0.01 * i for i in range(8)], [0.3 + 0.02 * i for i in range(8)]
    records = [floor(), floor(id=TANK), record("a", gaining(pipe)), record("a", gaining(tank), id=TANK, official=True),
               record("b", gaining([gain - 0.1 for gain in pipe])), record("b", gaining(tank), id=TANK),
               record("once", gaining(pipe)), record("b", times(0.1), board="smoothing")]
    table = boards(records)
    total = table[table["environment"] == ALL].set_index("method")
    assert list(total["class"].unique()) == ["filter"] and list(total.index) == ["a", "b", "homogeneous"]
    assert list(total["rank"][:2]) == [1, 2] and total["note"]["homogeneous"] == "floor"
    assert total["gain"]["a"] == pytest.approx(np.sort([*pipe, *tank])[4:12].mean())
    three = stratified_bootstrap({"eitbench-Pipe2D-v0": pipe, "eitbench-RotatingTank2D-v0": tank}, interquartile_mean)
    assert tuple(total.loc["a", ["gain", "gain_low", "gain_high"]]) == pytest.approx(three)
    assert total["error"].isna().all() and not total["official"].any()


def test_reference_environments_are_not_in_aggregates():
    """Their scores, in which no policy is better than fixed injections, would only level the
    others. Random pairs are the naive baseline of policies."""
    ids = [f"eitbench/Pipe2DInjection{name}-v0" for name in ("Faults", "Budget", "")]
    records = [record(method, [error] * 8, id=id, board="injection", role=role) for id in ids
               for method, error, role in (("random_pair", 0.2, "floor"), ("mine", 0.1 if id != ids[2] else 0.3, None))]
    total = boards(records).query("environment == @ALL").set_index("method")
    assert total["gain"]["mine"] == pytest.approx(0.5)


def test_an_aggregate_is_ranked_by_what_orders_it():
    """Aggregates use the interquartile mean of skill scores, which is robust to outliers; environments use the mean."""
    gains = {"daring": ([0.9] * 7 + [-9.0], [0.9] * 8), "steady": ([0.6] * 8,) * 2, "slow": ([0.3] * 8,) * 2}
    table = boards([floor(), floor(id=TANK), *(record(name, gaining(own), id=id) for name, both in gains.items()
                                               for id, own in zip((BOARD_IDS["filter"], TANK), both, strict=True))])
    total, one = (table[table["environment"] == name].set_index("method") for name in (ALL, "eitbench-Pipe2D-v0"))
    assert list(total.index) == ["daring", "steady", "slow", "homogeneous"]
    assert dict(total["rank"].dropna()) == {"daring": 1, "steady": 2, "slow": 3}
    assert one["gain"]["daring"] == pytest.approx(0.9) and one["gain_low"]["daring"] < 0.9
    assert list(one.index[:2]) == ["steady", "slow"] and dict(one["rank"].dropna()) == {
        "steady": 1, "slow": 2, "daring": 1}                           # too scattered for a significant difference


def test_time_in_products_and_memory():
    """Time is of the fastest episode, in units of the processor's median matrix product; memory is the maximum."""
    mine = record("a", FLOOR, scores={"seconds_per_step": 0.02})
    slow = RUN | {"machine": RUN["machine"] | {"processor": "An old abacus", "matmul_seconds": 0.2}}
    episodes = [episode | {"run": i % 2, "peak_memory": 10**8 + i} for i, episode in enumerate(mine["episodes"])]
    table = table_of(floor(), record("a", FLOOR, runs=[RUN, slow], episodes=episodes))
    assert tuple(table.loc["a", ["seconds_per_step", "matmuls_per_step"]]) == pytest.approx((20, 0.1))
    busy = RUN | {"machine": RUN["machine"] | {"matmul_seconds": 0.5}}             # another took 0.05
    timed = {"scores": {"seconds_per_step": 0.02}}
    b, c = record("b", FLOOR, runs=[busy], **timed), record("c", FLOOR, runs=[RUN], **timed)
    one = table_of(floor(), b, c)["matmuls_per_step"]
    assert one["b"] == one["c"] == pytest.approx(0.4)
    assert table["peak_memory"]["a"] == pytest.approx(100.000007) and pd.isna(table["peak_memory"]["homogeneous"])


def test_only_test_seeds():
    with pytest.raises(ValueError, match=r"made of test seeds; eitbench-Pipe2D-v0--a--\w+--dev\.json has dev"):
        boards([record("a", {"dev:0": 0.1})])


def test_old_versions_are_listed_and_not_mixed():
    """Ranks and skill scores do not depend on superseded records; the Markdown names them."""
    old = record("b", times(0.1), version="v1", finished="2026-01-01")
    records = [floor(), record("b", times(0.5), version="v2"), old]
    assert list(boards(records)["version"]) == ["v2", "v1"] and boards(records)["rank"].max() == 1
    text = render(collect(records))["leaderboard.md"]
    assert "- eitbench-Pipe2D-v0--b--v1.json" in text.split("## Superseded records")[1]
    assert "Superseded" not in render(collect(records[:2]))["leaderboard.md"]


@pytest.fixture
def folder(tmp_path):
    """Return a folder of records on three leaderboards."""
    random = np.random.default_rng(7)
    three = random.uniform(0.1, 0.2, (3, 8)).tolist()
    for each in (floor(official=True), floor(id=TANK, official=True),
                 record("a", three[0], version="v2", scores={"nis": 1.5}), record("b", [*three[1][:7], None]),
                 record("a", three[2], id=TANK, version="v2"),
                 record("random_pair", FLOOR, board="injection", role="floor", scores={"spent": 3}),
                 record("a", times(0.1), finished="2020-01-01", version="v1")):
        write_record(tmp_path, each)
    return tmp_path


def test_csv_and_markdown_agree_with_the_episodes(folder):
    """Means in the CSV equal the data frame, and the Markdown shows them rounded."""
    texts, frame = render(collect(read_records(folder))), load(folder)
    table = pd.read_csv(io.StringIO(texts["leaderboard.csv"]), keep_default_na=True)
    rows, frame = table[table["environment"] != ALL], frame[~frame["outdated"]]
    assert len(rows) == len(frame[["environment", "method"]].drop_duplicates()) == 6
    for _, row in rows.iterrows():
        own = frame[(frame["environment"] == row["environment"]) & (frame["method"] == row["method"])]
        values = own.groupby("metric")["value"].agg(["mean", "min"])
        for name in ("error", "nis", "spent", "seconds_per_step"):
            kind = "min" if name == "seconds_per_step" else "mean"
            assert name not in values.index or row[name] == pytest.approx(values[kind][name], rel=1e-5)
        title = row["environment"].removeprefix("eitbench/")
        section = texts["leaderboard.md"].split(f"### {title}, ")[1].split("###")[0].splitlines()
        (line,) = [line for line in section if f" {row['method']}@{row['version']} " in line]
        cells = dict(zip(*([cell.strip() for cell in text.split("|")] for text in (section[2], line)), strict=True))
        assert float(cells["ẽ_c"].split()[0]) == pytest.approx(row["error"], rel=0.1)
        ranked = row["rank"] > 0
        assert cells["rank"].split()[0] == (f"{row['rank']:.0f}" if ranked else "–")
        assert ranked or cells["method"].endswith(f"({BADGES.get(row['note'], row['note'])})")
        assert cells["run by"] == ("official" if row["official"] else "self-reported")
    assert "All environments" in texts["leaderboard.md"] and (table["environment"] == ALL).sum() == 2


def test_load_is_tidy(folder):
    """Each score of each episode has a row; failures are included, and outdated records are marked."""
    mine = record("isolated", [0.1, None], board="smoothing")
    mine["episodes"] = [episode | {"peak_memory": 10**8} for episode in mine["episodes"]]
    write_record(folder, mine)
    frame = load(folder)
    assert not frame.duplicated(["environment", "method", "version", "seed", "metric"]).any()
    errors = frame[(frame["metric"] == "error") & (frame["environment"] == "eitbench/Pipe2D-v0")]
    assert errors.groupby(["method", "version"]).size().to_dict() == {
        ("homogeneous", "v1"): 8, ("b", sha("b1")[:8]): 8, ("a", "v1"): 8, ("a", "v2"): 8}
    failed = frame[frame["status"] == "failed"]                                   # a single row, for any content
    assert failed["value"].isna().all() and sorted(zip(failed["method"], failed["seed"], failed["metric"], strict=True)
                                                   ) == [("b", "test:7", "error"), ("isolated", "test:1", "error")]
    assert set(frame[frame["outdated"]]["version"]) == {"v1"}
    ours = errors[(errors["method"] == "homogeneous") & errors["official"]]
    assert list(ours["value"]) == FLOOR and set(ours["role"]) == {"floor"}
    assert list(frame[frame["metric"] == "peak_memory"]["value"]) == [1e8]
    spent = frame[frame["metric"] == "spent"]
    assert set(spent["board"]) == {"injection"} and set(spent["value"]) == {3.0}


def test_the_example_in_the_docs_runs(folder):
    """docs/read_leaderboards.py prints each version's mean, the best first."""
    write_record(folder, record("a", times(0.8), version="2"))
    done = subprocess.run([sys.executable, str(ROOT / "docs" / "read_leaderboards.py"), str(folder)], check=True,
                          capture_output=True, text=True)
    frame = load(folder)
    frame = frame[(frame["metric"] == "error") & ~frame["outdated"] & (frame["environment"] == "eitbench/Pipe2D-v0")]
    best = frame.groupby(["method", "version"])["value"].mean().sort_values()
    lines = done.stdout.split("eitbench/Pipe2D-v0")[1].splitlines()[2:6]
    assert [tuple(line.split()[:2]) for line in lines] == list(best.index) and len(lines) == 4
    assert [float(line.split()[2]) for line in lines] == pytest.approx(list(best), abs=5e-5)


def official():
    """Return records of naive baseline, oracle and two methods in two environments."""
    return [record(name, times(factor), id=id, version="v1", role=role, official=True)
            for id in (BOARD_IDS["filter"], TANK)
            for name, factor, role in (("homogeneous", 1.0, "floor"), ("true_model_smoother", 0.1, "reference"),
                                       ("a", 0.5, None), ("b", 0.6, None))]


def official_rows(records):
    table = boards(records)
    return {(row["environment"], row["method"]): row for _, row in table[table["official"]].iterrows()}


@pytest.mark.parametrize("strangers", [
    [record("homogeneous", times(0.01), version="v99", role="floor")], [record("a", times(0.01), version="v99")],
    [record("true_model_smoother", times(9.0), version="v99", role="reference")],
    [record("homogeneous", times(0.01), version="v1", role="floor", finished="9999-12-31", id="eitbench/Pipe3D-v0")],
    [record("homogeneous", times(0.01), board="smoothing", role="floor", environment={
        "id": BOARD_IDS["filter"],
            "name": environment_name(BOARD_IDS["filter"], {"lag": "all"}), "kwargs": {"lag": "all"}})],
    [record("c", times(0.9), runs=[RUN | {"machine": RUN["machine"] | {"matmul_seconds": 1e-9}}] * 99)],
    [each | {"environment": each["environment"] | {"name": "eitbench-Pipe2D-v0-deadbeef"}}
     for each in (floor(), record("b", times(0.9)))],
], ids=["floor", "method", "reference", "elsewhere", "anchor of the skill", "matrix products", "invented name"])
def test_a_self_reported_record_changes_no_official_number(strangers):
    """Ranks and aggregates depend neither on unpublished versions, self-reported baselines, oracles and times, nor on
    environments with arguments, which would exclude all methods without them."""
    before, after = official_rows(official()), official_rows([*official(), *strangers])
    assert before.keys() == after.keys() and len(before) == 12 and any(key[0] == ALL for key in before)
    for key, row in before.items():
        assert row.drop("rank").equals(after[key].drop("rank")), (key, row.compare(after[key]))
