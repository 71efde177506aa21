"""README and documentation: links lead somewhere. Building the site (`docs/build.py`) checks more: anchors of generated
pages, README's first snippet, the notebooks."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

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


def test_an_estimator_reads_voltages_of_ones_own(capsys):
    """The page on measured data: the level of a homogeneous vessel comes out of its voltages."""
    text = (ROOT / "docs" / "measured-data.md").read_text(encoding="utf-8")
    snippet = re.findall(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)[1]
    exec(compile(snippet, "snippet", "exec"), {})
    assert capsys.readouterr().out == "28.00 mol/m³\n"


def test_documentation_builds():
    """All pages with the generated ones, links and anchors whole; no notebook is executed."""
    done = subprocess.run([sys.executable, "docs/build.py", "--draft"], cwd=ROOT, capture_output=True, text=True,
                          check=False)
    assert done.returncode == 0, done.stdout + done.stderr
