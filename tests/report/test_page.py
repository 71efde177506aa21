"""The page: one file that needs no other, true to the records, and safe whatever a baseline calls itself."""

import base64
import io
import json
import re
from html.parser import HTMLParser
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from eitbench.bench.run import Job, run_jobs
from eitbench.bench.store import EpisodeStore
from eitbench.bench.tracks import Environment
from eitbench.data.cache import CACHE_VARIABLE
from eitbench.numerics.round import extrude, uniform_disc
from eitbench.report import charts, page
from eitbench.report.summary import explanations, shown, summary
from eitbench.worlds.catalogue import PIPE_3D
from PIL import Image

from short import short, shorten
from tiny import FILTER, SCENARIO, SMOOTHING, git_says, write_baseline

EVIL = "Evil <script>alert('x')</script> & \\\"co\\\""
"""A title as it stands in a docstring; the page must show it and not run it."""


class Page(HTMLParser):
    """Tags with attributes, and text, of a page; unbalanced tags are an error."""

    VOID = ("meta", "img", "br", "link", "wbr", "input")

    def __init__(self, html):
        super().__init__()
        self.tags, self.text, self.open = [], [], []
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)

    def attributes(self, name):
        """Every value of an attribute."""
        return [attributes[name] for _, attributes in self.tags if name in attributes]


TANK = Environment("eitbench/StationaryTank2D-v0", json.dumps(short("eitbench/StationaryTank2D-v0")))


@pytest.fixture(scope="module")
def two_worlds(tmp_path_factory):
    """Pipe and tank, with meshes and records of different sizes: the records, and the page's text."""
    folder = tmp_path_factory.mktemp("worlds")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(CACHE_VARIABLE, str(folder / "cache"))
        git_says(patch)
        store = EpisodeStore(folder)
        run_jobs([Job(environment, "homogeneous", 1) for environment in (TANK, FILTER)], store)
        records = store.write_records()
        path = page.write_page(store, records, summary(records))
    return records, path.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with results of the tiny world on two boards, one failure among them; its records and its page."""
    folder = tmp_path_factory.mktemp("page")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(CACHE_VARIABLE, str(folder / "cache"))
        git_says(patch)
        for name in (FILTER.id, SMOOTHING.id):
            shorten(patch, {name: SCENARIO})
        evil = write_baseline(folder, "evil", doc=EVIL + ": bad.", update="return Estimate(self.level + self.calls)")
        failing = write_baseline(folder, "surely_failing", doc="Failing", update="raise RuntimeError('<b>&lt;')")
        store = EpisodeStore(folder)
        pairs = [(Environment(environment.id), baseline) for environment in (FILTER, SMOOTHING)
                 for baseline in ("homogeneous", evil)] + [(Environment(SMOOTHING.id), failing)]
        run_jobs([Job(*pair, seed) for pair in pairs for seed in (1, 2)], store,
                 command="eitbench run --baseline <script>")
        records = store.write_records()
        path = page.write_page(store, records, summary(records))
    return folder, records, path.read_text(encoding="utf-8")


def svgs(html):
    """The page's charts as XML trees; a parse error if one is malformed."""
    return [ElementTree.fromstring(text) for text in re.findall(r"<svg.*?</svg>", html, flags=re.DOTALL)]


def test_needs_nothing_else(made):
    """No script, no style sheet, no font, no picture from elsewhere; every address is data or within the page."""
    folder, _, html = made
    assert (folder / "index.html").stat().st_size < 1_000_000
    parsed = Page(html)
    assert not {tag for tag, _ in parsed.tags} & {"script", "link", "iframe", "object", "embed", "base"}
    addresses = [value for name in ("src", "href", "xlink:href", "action", "data") for value in parsed.attributes(name)]
    assert addresses and all(address.startswith(("data:", "#")) for address in addresses)
    assert not re.search(r"@import|url\(|javascript:", html)


def test_pictures_are_pictures(made):
    """Four times, truth and estimates each, and the colour bar: all decode as PNG, and say what they show."""
    tags = Page(made[2]).tags
    images = [attributes for tag, attributes in tags if tag == "img"]
    columns = [tag for tag, _ in tags].count("strong")
    assert columns >= 3 and len(images) == 4 * columns + 1
    assert all(image["alt"] for image in images)
    decoded = []
    for image in images:
        kind, content = image["src"].split(",")
        assert kind == "data:image/png;base64"
        picture = Image.open(io.BytesIO(base64.b64decode(content, validate=True)))
        assert picture.format == "PNG"
        decoded.append(np.asarray(picture.convert("RGB")))
    assert all(np.ptp(picture.astype(int), axis=(0, 1)).max() > 20 for picture in decoded[:-1:columns])  # the truth


def test_every_method_score_and_failure_is_there(made):
    """Titles, boards, number of episodes, reasons of failures, explanations of the columns, how it was made."""
    _, records, html = made
    text = " ".join(Page(html).text)
    asked = [text for heading, text in explanations().items() if heading not in ("ẽ_v", "injections")]
    for expected in ("Best homogeneous estimate", "Evil <script>alert", "Failing", "filter", "smoothing", "2 failed",
                     "RuntimeError: <b>&lt;", "eitbench run --baseline <script>", *asked,
                     records[0]["runs"][0]["versions"]["numpy"], records[0]["runs"][0]["machine"]["processor"]):
        assert expected in text, expected


def test_nothing_that_a_baseline_says_is_run(made):
    """Titles, messages and commands are text in the table, in attributes and in the charts."""
    html = made[2]
    assert "<script" not in html and "<b>" not in html
    charts_text = " ".join(text for chart in svgs(html) for text in chart.itertext())
    assert "Evil <script>alert" in charts_text


def test_charts_are_well_formed(made):
    """Two charts: an interval and a curve for each of the four methods that played, within the picture."""
    intervals, curves = svgs(made[2])
    assert len(intervals.findall("circle")) == 4 and len(curves.findall("polyline")) == 4
    width, height = (float(x) for x in curves.get("viewBox").split()[2:])
    for line in curves.findall("polyline"):
        points = np.array([point.split(",") for point in line.get("points").split()], dtype=float)
        assert len(points) == 3 and (np.diff(points[:, 0]) > 0).all()
        assert (points >= 0).all() and (points <= [width, height]).all()


def test_every_colour_is_defined(made):
    """However many methods there are, each line has a colour of the style sheet."""
    folder, records, _ = made
    many = [record | {"method": f"copy{i}"} for record in records if record["method"] == "homogeneous"
            for i in range(8)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page, "_snapshots", lambda *_: None)
        html = page.write_page(EpisodeStore(folder / "many"), many, summary(many)).read_text(encoding="utf-8")
    used = set(re.findall(r"var\((--c\d+)\)", html))
    assert len(used) > 3 and used <= set(re.findall(r"(--c\d+):", html))


def test_a_page_of_failures_only(made):
    """If nothing went well there is still a page that says so."""
    folder, records, _ = made
    failed = [record for record in records if record["method"] == "surely_failing"]
    html = page.write_page(EpisodeStore(folder / "failed"), failed, summary(failed)).read_text(encoding="utf-8")
    assert "2 failed" in html and svgs(html) == [] and "RuntimeError: <b>&lt;" in " ".join(Page(html).text)


def test_a_failure_does_not_take_the_snapshots_of_others(made, monkeypatch):
    """Whoever has estimates is shown, also beside a baseline that failed."""
    folder, records, _ = made
    monkeypatch.setenv(CACHE_VARIABLE, str(folder / "cache"))
    shorten(monkeypatch, {SMOOTHING.id: SCENARIO})
    first = sorted((record for record in records if record["board"] == "smoothing"),
                   key=lambda record: record["method"] != "surely_failing")
    snapshots = page._snapshots(EpisodeStore(folder), first)
    assert snapshots is not None and "Best homogeneous estimate" in snapshots["columns"]


def test_a_page_without_the_estimates(made, tmp_path):
    """Records are the source of truth: where only they were kept, all but the snapshots is drawn."""
    _, records, _ = made
    html = page.write_page(EpisodeStore(tmp_path), records, summary(records)).read_text(encoding="utf-8")
    assert len(svgs(html)) == 2 and "Snapshots" not in html


def test_snapshots_are_of_the_world_that_was_played(made, monkeypatch):
    """The truth beside the estimates is that of the record's environment with the record's arguments."""
    folder, records, _ = made
    asked = []

    class Watched(Environment):
        def make(self, **extra):
            asked.append(json.loads(self.kwargs))
            return FILTER.make()

    monkeypatch.setenv(CACHE_VARIABLE, str(folder / "cache"))
    monkeypatch.setattr(page, "Environment", Watched)
    given = {"kwargs": {"world": SCENARIO}}
    page._snapshots(EpisodeStore(folder), [record | {"environment": record["environment"] | given}
                                           for record in records if record["board"] == "filter"][:2])
    assert asked == [{"world": SCENARIO}]


@pytest.mark.parametrize("values", [[0.1], [0.1, 0.1], [0.2, 0.0, 0.3]], ids=["one step", "constant", "a zero"])
def test_odd_curves_can_be_drawn(values):
    """One scored step, no change at all, and a perfect estimate are drawn, not divided by."""
    series = [charts.Series("mine", 0, np.array(values))]
    chart = ElementTree.fromstring(charts.lines(np.arange(1, 1 + len(values)), series, "step", "error"))
    numbers = re.findall(r"[^ ,]+", chart.find("polyline").get("points"))
    assert len(numbers) == 2 * len(values) and np.isfinite(np.array(numbers, dtype=float)).all()


def test_intervals_of_one_episode_and_wide_ones():
    """An unknown interval is a dot, and one that reaches below zero ends at the edge of the chart."""
    rows = [charts.Series("one", 0, np.array([0.02, -np.inf, np.inf])),
            charts.Series("wide", 1, np.array([0.01, -0.49, 0.51]))]
    chart = ElementTree.fromstring(charts.intervals(rows, "ẽ_c"))
    one, wide = [line for line in chart.findall("line") if line.get("style")]
    assert one.get("x1") == one.get("x2") and float(wide.get("x2")) > float(wide.get("x1")) > max(
        float(text.get("x")) for text in chart.findall("text[@text-anchor='end']"))


@pytest.mark.parametrize("values", [[0.0], [0.0, 0.02]])
def test_perfect_scores_have_intervals(values):
    """A zero is drawn at the edge of the logarithmic axis."""
    rows = [charts.Series("one", 0, np.array([value, value, value])) for value in values]
    places = [float(mark.get("cx")) for mark in ElementTree.fromstring(charts.intervals(rows, "ẽ_c")).findall("circle")]
    assert np.isfinite(places).all() and (np.array(places) <= charts.WIDTH).all()


def test_other_seeds_do_not_take_the_snapshots_away(made, monkeypatch):
    """A method played on dev seeds beside ours on others, as README suggests: the pictures are still there."""
    folder, records, _ = made
    for name in (FILTER.id, SMOOTHING.id):
        shorten(monkeypatch, {name: SCENARIO})
    monkeypatch.setattr(page, "SHOWN", (("homogeneous", "filter"), ("homogeneous", "smoothing")))
    others = [record | {"split": "own", "seeds": ["300001"],
                        "episodes": [episode | {"seed": "300001"} for episode in record["episodes"][:1]]}
              for record in records]

    def pictures(shown):
        return page.write_page(EpisodeStore(folder), shown, summary(shown)).read_text(encoding="utf-8").count("<img")

    assert pictures(records + others) == pictures(records) > 1


# -- several worlds ---------------------------------------------------------------------------------------------------


def test_each_world_has_a_section(two_worlds):
    """Its own table, intervals, curve over its own steps and snapshots; links at the top lead to them."""
    records, html = two_worlds
    Page(html)
    sections = re.findall(r"<section.*?</section>", html, flags=re.DOTALL)
    names = [re.search(r"<h2>(.*?)</h2>", section)[1] for section in sections]
    assert len(names) == 2 and names[0].startswith("Pipe2D (") and names[1].startswith("StationaryTank2D (")
    for section, steps in zip(sections, (3, 5), strict=True):
        intervals, curves = svgs(section)
        assert len(intervals.findall("circle")) == 1 and section.count("<table") == 1 and "<th" in section
        assert len(curves.find("polyline").get("points").split()) == steps
        assert section.count("<img") == 4 * 2 + 1 and set(re.findall(r"var\((--c\d+)\)", section)) == {"--c0"}
    identities = [attributes["id"] for tag, attributes in Page(html).tags if tag == "section"]
    assert Page(html).attributes("href") == [f"#{name}" for name in identities] and len(set(identities)) == 2
    table = shown(summary(records)).markdown().splitlines()
    assert table[0].startswith("| environment") and table[2].startswith(f"| {names[0]}")


def test_only_pipes_are_said_to_flow(two_worlds):
    """Captions and pictures fit the world: a long pipe with a flow, a round tank without one."""
    pipe, tank = re.findall(r"<section.*?</section>", two_worlds[1], flags=re.DOTALL)
    assert "40 cm × 10 cm; flow from left to right" in pipe
    assert "flow from" not in tank and " cm across; one colour scale" in tank
    for section, ratio in ((pipe, 4.0), (tank, 1.0)):
        first = re.search(r"data:image/png;base64,([^\"]+)", section)[1]
        picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(first))))
        assert picture.shape[1] / picture.shape[0] == pytest.approx(ratio, rel=0.03)
        assert (picture[0, 0, 3] == 0) == (section == tank)            # a disc leaves the corners free


def test_one_world_needs_no_sections(made):
    """The page of one world has its headings where they were, and no links."""
    tags = Page(made[2]).tags
    assert not {"section", "nav", "h3", "a"} & {tag for tag, _ in tags}
    assert [tag for tag, _ in tags].count("h2") == 6


def test_a_round_pipe_is_cut_along_its_axis():
    """In 3D the picture is as long as the pipe and as high as it is wide, and shows what changes along it."""
    mesh = extrude(uniform_disc(0.05, 4), np.linspace(0.0, 0.4, 5))
    task = SimpleNamespace(mesh=mesh, expected_concentration=1.0, vessel=PIPE_3D.vessel)
    assert page._size(task) == "40 cm long, 10 cm across, cut along the axis; flow from left to right"
    content = page._picture(task, mesh, 0.6 + 3.0 * mesh.points[:, 2]).split(",")[1]
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(content))).convert("RGB")).astype(int)
    assert picture.shape[1] / picture.shape[0] == pytest.approx(4.0, rel=0.05)
    middle = picture[len(picture) // 2]
    assert np.abs(middle[20] - middle[-20]).max() > 100


def test_curves_may_end_before_others():
    """Records of different lengths share a chart; each line has as many points as its record has steps."""
    def record(title, steps):
        return {"title": title, "board": "filter", "split": "test", "environment": {"kwargs": {}},
                "episodes": [{"status": "ok", "step_errors": [0.1] * steps}]}

    for lengths in ([3, 5], [5, 3]):
        lines = ElementTree.fromstring(page._curves([record("mine", steps) for steps in lengths])).findall("polyline")
        assert [len(line.get("points").split()) for line in lines] == lengths


@pytest.mark.parametrize(("low", "high"), [(0.01, 10.0), (0.025, 0.036), (0.0301, 0.0329), (0.0107, 0.0199)])
def test_every_axis_has_ticks(low, high):
    """Two of them at least, however near the values lie; all within."""
    ticks = charts._log_ticks(low, high)
    assert len(ticks) > 1 and all(low <= tick <= high for tick in ticks) and ticks == sorted(ticks)
