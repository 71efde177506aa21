"""The site in a real browser: sorting, filtering, following a link, the theme, and a phone's width.

Chromium opens a page with a frame of the given width; a script around the frame acts on the site inside and
returns its result as JSON. Clicks and keys are events of that script.
"""

import html
import json
import re
import shutil
import subprocess

import pytest
from eitbench.bench.records import with_content_hash
from eitbench.bench.store import EpisodeStore
from eitbench.report.boards import run_leaderboards
from eitbench.report.page import write_page
from eitbench.report.site import HEADLINE, collect, render_site, write_site
from PIL import Image

from tiny import record, several_boards

CHROMIUM = next(filter(None, map(shutil.which, (
    "chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="Chromium and Chrome are not on the PATH")
BOARD, AGENTS = "#board-filter-eitbench-Pipe2D-v0", "#board-injection-eitbench-Pipe2DInjectionFaults-v0"
ENVIRONMENT, METHOD = "environments/eitbench-Pipe2D-v0.html", "methods/a.html"
"""One page of each kind, besides the index."""
DARK = "--blink-settings=preferredColorScheme=0"
STILL = "--force-prefers-reduced-motion"
OPEN_TRAININGS = f"""
        const parts = () => shown("{AGENTS} tr.part").length, before = parts();
        one("{AGENTS} summary").click();
        found.trainings = [all("{AGENTS} summary").length, before, parts()];"""
HARNESS = """<body><iframe id="frame" style="width: {width}px; height: 900px; border: 0"></iframe><script>
const frame = document.getElementById("frame"), errors = [];
const one = (selector) => frame.contentDocument.querySelector(selector);
const all = (selector) => [...frame.contentDocument.querySelectorAll(selector)];
const shown = (selector) => all(selector).filter((it) => it.checkVisibility());
const style = (selector) => frame.contentWindow.getComputedStyle(one(selector));
const type = (words) => {{
  one("input[type=search]").value = words;
  one("input[type=search]").dispatchEvent(new Event("input", {{bubbles: true}}));
}};
const open = (address) => new Promise((resolve) => {{
  frame.onload = () => {{ frame.contentWindow.onerror = (message) => errors.push(message); resolve(); }};
  frame.src = address;
}});
(async () => {{
  if (!{scripts}) frame.sandbox = "allow-same-origin";
  await open({page});
  return await (async () => {{ {script} }})();
}})().catch((error) => ({{failed: String(error)}})).then((answer) => {{
  document.body.dataset.answer = JSON.stringify({{answer, errors}});
}});
</script></body>"""


def answer(page, script, *flags, width=1200, scripts=True):
    """Return the JSON-ready result of a script on a page in a frame; errors in the page's console fail."""
    harness = page.with_name("harness.html")
    harness.write_text(HARNESS.format(width=width, scripts=json.dumps(scripts), page=json.dumps(page.as_uri()),
                                      script=script), encoding="utf-8")
    try:
        done = subprocess.run(
            [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
             "--hide-scrollbars", *flags,
             "--allow-file-access-from-files", "--host-resolver-rules=MAP * ~NOTFOUND", "--virtual-time-budget=30000",
             f"--user-data-dir={page.parent / 'profile'}", "--dump-dom", harness.as_uri()],
            capture_output=True, text=True, timeout=120, check=True)
    finally:
        harness.unlink()
    found = json.loads(html.unescape(re.search(r'data-answer="([^"]*)"', done.stdout)[1]))
    assert not found["errors"] and "failed" not in (found["answer"] or {}), found
    return found["answer"]


def widest():
    """Return records with all scores of an estimator, and the anchors of its normalised score."""
    scores = {"contrast_error": 2.28, "nis": 1.44, "crps": 0.98, "velocity_error": 2.3e-32, "coverage_50": 0.58,
              "coverage_90": 0.88, "spread_ratio": 1.44, "voltage_discrepancy": 1e-4, "seconds_per_step": 0.465}
    errors = {"homogeneous": 0.0213, "true_model_smoother": 0.0027, "extended_kalman_filter": 0.0048}
    found = [record(name, [0.8 * error, error, 1.3 * error, error, error, 1.1 * error], scores=scores, official=True,
                    id="eitbench/Pipe2DUnknownVelocity-v0", role={"homogeneous": "floor"}.get(name))
             for name, error in errors.items()]
    for each in (episode for one in found for episode in one["episodes"]):
        each["peak_memory"] = 3_071_000_000
    return [with_content_hash(one) for one in found]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made, records = tmp_path_factory.mktemp("site"), [*several_boards(), *(
        record(f"ppo_seed{seed}", [0.1 + 0.01 * seed] * 8, board="injection",
               title=f"ppo trained with seed {seed}") for seed in (0, 1))]
    write_site(made, render_site(collect(records)))
    return made


def test_sort_filter_and_explain(folder):
    """Tables sort up, down, and by another column, rows without a value last; aria-sort names the order. Text filters
    methods and environments, each box hides one kind, and a count shows the remaining rows. Column descriptions open by
    pointer and keyboard; Escape closes them. Training seeds expand; they are sorted and filtered as one row."""
    found = answer(folder / "index.html", f"""
        const cells = (k) => shown("{BOARD} tbody tr").map((row) => row.cells[k].textContent.trim());
        const names = () => cells(1), found = {{order: []}};
        const heads = all("{BOARD} thead th"), time = heads.findIndex((cell) => cell.textContent === "ms/step");
        const first = names().sort().join();
        for (const column of [time, time, 0]) {{
          heads[column].querySelector("button").click();
          found.order.push([cells(column), heads.map((cell) => cell.ariaSort).filter(Boolean)]);
        }}
        found.same = first === names().sort().join();

        const header = heads[3], button = header.querySelector("button"), tips = found.tips = [];
        const tip = () => tips.push(one(".tip:popover-open")?.textContent ?? null);
        button.focus({{focusVisible: true}});
        tip();
        tips.push(button.ariaDescription);
        button.dispatchEvent(new KeyboardEvent("keydown", {{key: "Escape"}}));
        tip();
        for (const kind of ["mouseenter", "mouseleave"]) {{
          header.dispatchEvent(new MouseEvent(kind));
          tip();
        }}

        {OPEN_TRAININGS}
        one("{AGENTS} thead th:nth-child(2) button").click();
        found.agents = all("{AGENTS} tbody tr").map((row) => row.cells[1].textContent);
        type("ppo_seed1");
        found.one = one("output").textContent;

        found.every = cells(1).length;
        type("TWIN tank");
        found.count = one("output").textContent;
        found.blocks = shown(".block").map((block) => block.id);
        found.injection = one("#class-injection").checkVisibility();
        type("");
        found.again = names();
        one("input[name=unranked]").click();
        found.ranked = names().join(" ");
        one("input[name='self-reported']").click();
        found.official = names();
        return found;""", STILL)
    (up, ascending), (down, descending), (ranks, third) = found["order"]
    times = list(map(float, up))
    assert times == sorted(times) and list(map(float, down)) == times[::-1] and found["same"]
    assert (ascending, descending, third) == (["ascending"], ["descending"], ["ascending"])
    known = [int(re.match(r"\d+", rank)[0]) for rank in ranks if rank != "–"]
    assert known == sorted(known) and ranks[len(known):] == ["–"] * (len(ranks) - len(known)) and "–" in ranks
    tips = found["tips"]
    assert tips[0].startswith("1 − ẽ_c") and tips == [tips[0], tips[0], None, tips[0], None]
    assert found["trainings"] == [1, 0, 2] and found["one"].startswith("1 of")
    assert [re.findall("seed.(?=@)", name) for name in found["agents"] if "ppo" in name.lower()] == [
        [], ["seed0"], ["seed1"]]
    assert found["count"].startswith("1 of ") and found["blocks"] == ["board-filter-eitbench-RotatingTank2D-v0"]
    assert not found["injection"] and found["every"] == 0 and len(found["again"]) == len(ranks)
    assert not re.search("floor|reference", found["ranked"]) and "failing" in found["ranked"]
    (official,) = found["official"]
    assert "twin" in official


def test_trainings_open_without_scripts(folder):
    assert answer(folder / "index.html", f"const found = {{}}; {OPEN_TRAININGS} return found.trainings;",
                  scripts=False) == [1, 0, 2]


def test_dark_by_preference_and_by_choice(folder):
    """The page follows the system until the reader chooses; other pages remember the choice."""
    script = f"""
        const paper = () => style("body").backgroundColor, words = () => one(".theme").textContent;
        const first = paper(), before = words();
        one(".theme").click();
        const second = paper(), after = words();
        await open({json.dumps((folder / METHOD).as_uri())});
        return [first, before, second, after, paper()];"""
    light = answer(folder / "index.html", script)
    shutil.rmtree(folder / "profile")                        # forgets the choice
    dark = answer(folder / "index.html", script, DARK)
    shutil.rmtree(folder / "profile")
    (paper, ink), words = (light[0], dark[0]), ["Use dark colours", "Use light colours"]
    assert paper != ink
    assert light == [paper, words[0], ink, words[1], ink] and dark == [ink, words[1], paper, words[0], paper]


def test_nothing_overflows(folder, tmp_path):
    """Wide content scrolls within its container, which the keyboard reaches: site and results page, which is
    sortable like the site, on a phone and a desk."""
    report = write_page(EpisodeStore(tmp_path), run_leaderboards(widest()))
    pages = [folder / "index.html", folder / ENVIRONMENT, folder / METHOD, report]
    found = answer(pages[0], f"""
        const found = [];
        for (const width of [380, 1200]) {{
          frame.style.width = `${{width}}px`;
          for (const page of {json.dumps([page.as_uri() for page in pages])}) {{
            await open(page);
            one("thead th:nth-child(2) button").click();
            all("details").forEach((details) => {{ details.open = true; }});
            found.push([width, frame.contentDocument.documentElement.scrollWidth, one("tbody td").textContent,
              all("table, pre, figure > div > svg").every(
                (it) => it.closest('.card[tabindex="0"][role=region][aria-label]')),
              all(".card").some((card) => card.scrollWidth > card.clientWidth)]);
          }}
        }}
        return found;""")
    assert len(found) == 8 and found[3][2] == found[7][2] == "True model smoother"
    for width, full, _, contained, wide in found:
        assert full == width and contained and (wide or width > 380)


@pytest.mark.parametrize(("flags", "first"), [((), 0), ((STILL,), 1)], ids=["moving", "still"])
def test_the_picture_can_be_stopped(flags, first, tmp_path):
    """A button pauses the animation; it is paused if the system prefers reduced motion."""
    records = [record(name, [error] * 2, id=id, official=True, version="v1")
               for id in ("eitbench/Pipe2D-v0", "eitbench/RotatingTank2D-v0") for name, error in (
                   ("homogeneous", 0.02), ("gauss_newton", 0.037), ("extended_kalman_filter", 0.004))]
    (tmp_path / "media").mkdir()
    for name in HEADLINE:
        Image.new("RGB", (72, 60), "teal").save(tmp_path / name)
    write_site(tmp_path / "site", render_site(collect(records, tmp_path)))
    before, words, after = answer(tmp_path / "site" / "index.html", """
        const image = one(".hero img"), before = image.currentSrc, words = one(".pause").textContent;
        one(".pause").click();
        await new Promise((resolve) => setTimeout(resolve, 100));
        return [before, words, image.currentSrc];""", *flags)
    assert before.endswith(HEADLINE[first]) and after.endswith(HEADLINE[1 - first])
    assert words == ["Pause", "Play"][first]
