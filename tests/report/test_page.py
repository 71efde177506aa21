"""The HTML report: one offline file with the records' numbers, images, failures and sweeps; and its charts."""

import base64
import io
import json
import re
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from eitbench.bench.run import Job, run_jobs
from eitbench.bench.store import EpisodeStore
from eitbench.bench.tracks import Environment
from eitbench.data.cache import CACHE_VARIABLE
from eitbench.numerics.round_meshes import extrude, uniform_disc
from eitbench.report import charts, page
from eitbench.report.boards import run_leaderboards
from eitbench.worlds.catalogue import PIPE_3D
from pages import Page, svgs
from PIL import Image

from short import short, shorten
from tiny import FILTER, SMOOTHING, git_says, write_baseline

EVIL = "Evil <script>alert('x')</script> & \\\"co\\\""
"""A title with HTML; the page must escape it."""
TANK = Environment("eitbench/StationaryTank2D-v0", json.dumps(short("eitbench/StationaryTank2D-v0")))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Return a folder with results of short pipes and a tank, one method failing; its records, and its page."""
    folder = tmp_path_factory.mktemp("page")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(CACHE_VARIABLE, str(folder / "cache"))
        git_says(patch)
        shorten(patch, FILTER.id, SMOOTHING.id)
        evil = write_baseline(folder, "evil", doc=EVIL + ": bad.", update="return Estimate(self.level + self.calls)")
        failing = write_baseline(folder, "surely_failing", doc="Failing", update="raise RuntimeError('<b>&lt;')")
        store = EpisodeStore(folder)
        pairs = [(Environment(environment.id), baseline) for environment in (FILTER, SMOOTHING)
                 for baseline in ("homogeneous", evil)] + [(Environment(SMOOTHING.id), failing), (TANK, "gauss_newton")]
        run_jobs([Job(*pair, seed) for pair in pairs for seed in (1, 2)], store,
                 command="eitbench run --baseline <script>")
        records = store.write_records()
        path = page.write_page(store, run_leaderboards(records))
    return folder, records, path.read_text(encoding="utf-8")


def test_the_page_needs_nothing_else(made):
    """Every address is data or within the page; titles, messages and commands are escaped."""
    html = made[2]
    parsed = Page(html)
    assert not {tag for tag, _ in parsed.tags} & {"iframe", "object", "embed", "base"}
    addresses = [value for name in ("src", "href", "action", "data") for value in parsed.attributes(name)]
    assert addresses and all(address.startswith(("data:", "#")) for address in addresses)
    assert len(html) < 1_000_000 and not re.search(r"@import|url\(|javascript:", html)
    assert html.count("<script") == 1 and "<b>&" not in html and html.count("alert(") == html.count("script&gt;alert(")
    assert "Evil <script>alert" in " ".join(text for chart in svgs(html) for text in chart.itertext())


def test_each_environment_has_a_section(made):
    """A leaderboard has title, scores of each method, charts over time, failures with the user's lines, provenance."""
    _, records, html = made
    sections = re.findall(r'<section id="board-.*?</section>', html, flags=re.DOTALL)
    names = [re.search(r"<h2>(.*?)</h2>", section)[1] for section in sections]
    assert names[:2] == ["Pipe2D-v0", "Pipe2DSmoothing-v0"] and names[2].startswith("StationaryTank2D-v0 (")
    for section, steps, methods in zip(sections, (3, 3, 5), (2, 2, 1), strict=True):
        (curves,) = svgs(section)
        lines = curves.findall("polyline[@class='series']")
        assert len(lines) == methods
        assert {len(line.get("points").split()) for line in lines} == {steps}
    text = " ".join(Page(html).text)
    for expected in ("Best homogeneous estimate", "Evil <script>alert", "2 failed", "RuntimeError: <b>&lt;",
                     'File "surely_failing.py", line', "eitbench run --baseline '<script>'",
                     records[0]["runs"][0]["versions"]["numpy"], records[0]["runs"][0]["machine"]["processor"]):
        assert expected in text, expected


def test_pictures_show_truth_and_estimates(made):
    """Images are PNG data with alternative texts: long pipes with a flow, round tanks without."""
    sections = re.findall(r'<section id="board-.*?</section>', made[2], flags=re.DOTALL)
    for section, times, ratio in zip(sections, (2, 2, 3), (4.0, 4.0, 1.0), strict=True):
        images = [attributes for tag, attributes in Page(section).tags if tag == "img"]
        assert len(images) == 2 * times + 1 and all(image["alt"] for image in images)
        kind, content = images[0]["src"].split(",")
        picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(content, validate=True))))
        assert kind == "data:image/png;base64" and np.ptp(picture[..., :3].astype(int), axis=(0, 1)).max() > 20
        assert picture.shape[1] / picture.shape[0] == pytest.approx(ratio, rel=0.03)
        assert (picture[0, 0, 3] == 0) == (ratio == 1.0)               # the corners outside a disc are empty
        assert ("flow from left to right" in section) == (ratio == 4.0)


def test_a_page_of_failures_or_without_estimates(made, tmp_path):
    """A page from records alone has everything except images."""
    _, records, _ = made
    failed = [each for each in records if each["method"] == "surely_failing"]
    html = page.write_page(EpisodeStore(tmp_path), run_leaderboards(failed)).read_text(encoding="utf-8")
    assert "2 failed" in html and svgs(html) == [] and "RuntimeError: <b>&lt;" in " ".join(Page(html).text)
    html = page.write_page(EpisodeStore(tmp_path), run_leaderboards(records)).read_text(encoding="utf-8")
    assert len(svgs(html)) == 3 and "Snapshots" not in html


def test_a_round_pipe_is_cut_along_its_axis():
    """The image of a 3D pipe is the section along the pipe, with its length and width."""
    mesh = extrude(uniform_disc(0.05, 4), np.linspace(0.0, 0.4, 5))
    task = SimpleNamespace(mesh=mesh, expected_concentration=1.0, vessel=PIPE_3D.vessel)
    assert page._size(task) == "40 cm long, 10 cm across, cut along the axis; flow from left to right"
    content = page._picture(task, mesh, 0.6 + 3.0 * mesh.points[:, 2]).split(",")[1]
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(content))).convert("RGB")).astype(int)
    assert picture.shape[1] / picture.shape[0] == pytest.approx(4.0, rel=0.05)
    middle = picture[len(picture) // 2]
    assert np.abs(middle[20] - middle[-20]).max() > 100


@pytest.mark.parametrize("values", [[0.1], [0.1, 0.1], [0.2, 0.0, 0.3]], ids=["one step", "constant", "a zero"])
def test_odd_values_can_be_drawn(values):
    """One step, no change and a perfect estimate are within the chart, as curves and marks."""
    series = [charts.Series("mine", 0, np.array(values))]
    points = [charts.ParetoPoint("p", 0, value, value) for value in values]
    for drawn in (charts.line_chart(np.arange(1, 1 + len(values)), series, "step", "error"),
                  charts.pareto_chart(points, "ms", "error")):
        chart = ElementTree.fromstring(drawn.svg)
        width, height = (float(x) for x in chart.get("viewBox").split()[2:])
        marks = [(float(mark.get("cx")), float(mark.get("cy"))) for mark in chart.iter("circle")]
        marks += [tuple(map(float, point.split(","))) for line in chart.iter("polyline")
                  for point in line.get("points").split()]
        assert marks and all(0 <= x <= width and 0 <= y <= height for x, y in marks)


def test_the_front_has_the_methods_that_no_other_beats():
    """The front has fast inaccurate and slow accurate methods, without dominated ones and the naive baseline."""
    points = [charts.ParetoPoint(name, i, x, y, competes) for i, (name, x, y, competes) in enumerate([
        ("good", 9.0, 1.0, True), ("fast", 1.0, 5.0, True), ("beaten", 9.0, 5.0, True), ("between", 3.0, 2.0, True),
        ("same time, worse", 1.0, 6.0, True), ("floor", 0.1, 0.5, False)])]
    assert [point.name for point in charts.pareto_front(points)] == ["fast", "between", "good"]
    chart = ElementTree.fromstring(charts.pareto_chart(points, "ms", "error").svg)
    assert len(chart.findall("circle")) == 6
    assert len(chart.find("polyline[@class='front']").get("points").split()) == 3


@pytest.mark.parametrize(("low", "high", "log", "expected"), [
    (0.0, 100.0, False, list(range(0, 101, 10))), (-0.3, 1.0, False, [-0.2, 0.0, 0.2, 0.4, 0.6, 0.8, 1.0]),
    (0.0, 606208.0, False, [1e5 * i for i in range(7)]), (1e-6, 1e3, True, [10.0**e for e in range(-6, 4)]),
    (0.0301, 0.0329, True, [0.0305 + 0.0005 * i for i in range(5)])])
def test_ticks_are_round_and_few(low, high, log, expected):
    assert charts.Axis(low, high, 0, 1, log=log).ticks() == pytest.approx(expected)
