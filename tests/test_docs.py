"""README and documentation: links lead somewhere, snippets run and print what is said."""

import contextlib
import io
import json
import re
from pathlib import Path

import pytest

from short import PIPE

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md",
         ROOT / "leaderboards" / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def anchors(path: Path) -> set[str]:
    """Of a page's headings, as GitHub and the site make them."""
    text = re.sub(r"^```.*?^```$", "", path.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading).strip().lower().replace(" ", "-") for heading in headings}


def targets(path: Path) -> list[str]:
    """Where the links and pictures of a page or notebook lead."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "markdown"]
        text = "\n".join("".join(cell["source"]) for cell in cells)
    text = re.sub(r"^ *```.*?^ *```$", "", text, flags=re.DOTALL | re.MULTILINE)
    return [target for target in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in target]


@pytest.mark.parametrize("page", [*PAGES, *sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))],
                         ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page):
    """Every link within the repository names a file or folder that is there, and a heading of it."""
    for target in targets(page):
        name, _, anchor = target.partition("#")
        there = (page.parent / name).resolve() if name else page
        assert there.exists(), target
        assert not anchor or anchor in anchors(there), target


def test_readme_is_short():
    """Whoever opens it reads to the end."""
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) < 120


def printed(snippet: str) -> str:
    """What a snippet of Python prints."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(compile(snippet, "snippet", "exec"), {})
    return " ".join(out.getvalue().split())


def snippets(page: Path) -> list[str]:
    """The Python of a page."""
    return re.findall(r"^```python\n(.*?)^```$", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def test_first_snippet_runs():
    """In a short pipe: nothing is paid in the warm-up, and errors are smaller than of knowing nothing. What it prints in
    the real one is compared when the documentation is built."""
    snippet = snippets(ROOT / "README.md")[0].replace('Pipe2D-v0")', f'Pipe2D-v0", world={PIPE})')
    snippet = snippet.replace("range(1, 31)", "range(1, 8)").replace("[18:]", "").replace("/ 12", "/ 5")
    rewards, mean = re.fullmatch(r"\[(.*)\] mean error (.*)", printed(snippet)).groups()
    paid = [float(reward) for reward in rewards.split(", ")]
    assert paid[:2] == [0.0, 0.0] and max(paid[2:]) < 0.0
    assert float(mean) < 0.05


def test_an_estimator_reads_voltages_of_ones_own():
    """The page on measured data: the level of a homogeneous vessel comes out of its voltages."""
    assert printed(snippets(ROOT / "docs" / "measured-data.md")[0]) == "28.00 mol/m³"
