"""README and documentation: links are valid. Building the site (`docs/build.py`) checks more: anchors of generated
pages, README's first snippet, the notebooks."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
sys.path.append(str(ROOT / "studies"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md",
         ROOT / "leaderboards" / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def anchors(path: Path) -> set[str]:
    """Return the anchors of a page's headings on GitHub and on the site."""
    text = re.sub(r"^```.*?^```$", "", path.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading).strip().lower().replace(" ", "-") for heading in headings}


def targets(path: Path) -> list[str]:
    """Return the targets of the links and images of a page or notebook."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "markdown"]
        text = "\n".join("".join(cell["source"]) for cell in cells)
    text = re.sub(r"^ *```.*?^ *```$", "", text, flags=re.DOTALL | re.MULTILINE)
    return [target for target in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in target]


@pytest.mark.parametrize("page", [*PAGES, *sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))],
                         ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page):
    """Every link within the repository points to an existing file or folder, and to an existing heading."""
    for target in targets(page):
        name, _, anchor = target.partition("#")
        there = (page.parent / name).resolve() if name else page
        assert there.exists(), target
        assert not anchor or anchor in anchors(there), target


@pytest.mark.parametrize("page", ["estimators", "methods", pytest.param("environments", marks=pytest.mark.slow)])
def test_table_is_current(page):
    """The table of a page is what `studies/document_tables.py` makes, with a row for each estimator."""
    import document_tables
    assert document_tables.ASSUMPTIONS.keys() == {path.stem for path in (ROOT / "baselines").glob("[!_]*.py")}
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    assert getattr(document_tables, page)() in text, "run `python studies/document_tables.py`"


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) < 130


def test_an_estimator_reads_voltages_of_ones_own(capsys):
    """The example in docs/measured-data.md estimates c_ref of a homogeneous vessel."""
    text = (ROOT / "docs" / "measured-data.md").read_text(encoding="utf-8")
    snippet = re.findall(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)[1]
    exec(compile(snippet, "snippet", "exec"), {})
    assert capsys.readouterr().out == "28.00 mol/m³\n"


def test_documentation_builds():
    """The draft has all pages, with valid links and anchors; notebooks are not executed."""
    done = subprocess.run([sys.executable, "docs/build.py", "--draft"], cwd=ROOT, capture_output=True, text=True,
                          check=False)
    assert done.returncode == 0, done.stdout + done.stderr
