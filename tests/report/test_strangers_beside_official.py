"""What a self-reported record says of itself changes nothing for the official ones beside it."""

import pytest
from eitbench.bench.records import newest
from eitbench.bench.tracks import named
from eitbench.report.boards import ALL, boards
from eitbench.report.site import render_site

from tiny import BOARD_IDS, RUN, record

FLOOR = [0.20, 0.24, 0.22, 0.26, 0.18, 0.30, 0.25, 0.21]
TANK = "eitbench/RotatingTank2D-v0"


def of(factor):
    return [factor * error for error in FLOOR]


def official():
    """Floor, reference and two methods in two environments."""
    return [record(name, of(factor), id=id, version="v1", role=role, official=True)
            for id in (BOARD_IDS["filter"], TANK)
            for name, factor, role in (("homogeneous", 1.0, "floor"), ("true_model_smoother", 0.1, "reference"),
                                       ("a", 0.5, None), ("b", 0.6, None))]


def rows(records):
    """(environment, method) -> row, of official records and of the aggregate."""
    table = boards(records)
    table = table[table["official"]]
    return {(row["environment"], row["method"]): row for _, row in table.iterrows()}


@pytest.mark.parametrize("strangers", [
    [record("homogeneous", of(0.01), version="v99", role="floor")], [record("a", of(0.01), version="v99")],
    [record("true_model_smoother", of(9.0), version="v99", role="reference")],
    [record("homogeneous", of(0.01), version="v1", role="floor", finished="9999-12-31", id="eitbench/Pipe3D-v0")],
    [record("c", of(0.9), runs=[RUN | {"machine": RUN["machine"] | {"matmul_seconds": 1e-9}}] * 99)],
], ids=["floor", "method", "reference", "elsewhere", "matrix products"])
def test_a_stranger_moves_no_official_number(strangers):
    """Not by a version that nobody has published, nor by a floor, a reference or a time of his own."""
    before, after = rows(official()), rows([*official(), *strangers])
    assert before.keys() == after.keys() and len(before) == 12 and any(key[0] == ALL for key in before)
    for key, row in before.items():
        same = row.drop("rank").equals(after[key].drop("rank"))
        assert same, (key, row.compare(after[key]))


def test_skill_is_anchored_by_official_records():
    """Whoever gives an environment another lag does not become the anchor of its skill."""
    kwargs = {"lag": "all"}
    id = BOARD_IDS["filter"]
    longest = record("homogeneous", of(0.01), board="smoothing", role="floor",
                     environment={"id": id, "name": named(id, kwargs), "kwargs": kwargs})
    before, after = rows(official()), rows([*official(), longest])
    assert before[id.replace("/", "-"), "a"]["skill"] == after[id.replace("/", "-"), "a"]["skill"]


def test_only_official_versions_make_official_ones_outdated():
    """Among self-reported ones the highest is current, whoever reported it."""
    v1, v2 = (record("a", FLOOR, version=version, official=True) for version in ("v1", "v2"))
    v9, v3, v0 = (record("a", FLOOR, version=version) for version in ("v9", "v3", "v1"))
    assert newest([v1, v2]) == ([v2], [v1]) and newest([v1, v9]) == ([v1, v9], [])
    assert newest([v2, v0]) == ([v2], [v0]) and newest([v1, v2, v3, v9]) == ([v2, v9], [v1, v3])


def test_the_page_of_a_method_has_the_official_title():
    """However late somebody else says that he played."""
    ours = official()
    late = record("a", of(0.5), version="v99", title="Bought", finished="9999-12-31")
    page = render_site([*ours, late], boards([*ours, late]))["methods/a.html"].decode()
    assert "<h1>A</h1>" in page and "<h1>Bought" not in page
