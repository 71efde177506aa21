"""README and documentation: links are valid, also those within the site, which `docs/build.py` checks."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
sys.path.append(str(ROOT / "studies"))


def test_links_of_the_readme_lead_somewhere():
    """Every link within the repository points to an existing file or folder, and to an existing heading."""
    text = re.sub(r"^ *```.*?^ *```$", "", (ROOT / "README.md").read_text(encoding="utf-8"), flags=re.DOTALL | re.M)
    for link in re.findall(r"\]\(([^)\s:]+)\)", text):
        name, _, anchor = link.partition("#")
        assert (ROOT / name).exists(), link
        headings = re.findall(r"^#+ (.*)$", (ROOT / name).read_text(encoding="utf-8"), re.M) if anchor else []
        assert anchor in {"", *(heading.lower().replace(" ", "-") for heading in headings)}, link


@pytest.mark.parametrize("page", ["estimators", "methods", pytest.param("environments", marks=pytest.mark.slow)])
def test_table_is_current(page):
    """The table of a page is what `studies/document_tables.py` makes, with a row for each estimator."""
    import document_tables
    assert document_tables.ASSUMPTIONS.keys() == {path.stem for path in (ROOT / "baselines").glob("[!_]*.py")}
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    assert getattr(document_tables, page)() in text, "run `python studies/document_tables.py`"


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
