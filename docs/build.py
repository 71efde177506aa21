"""Build the documentation: `python docs/build.py`, then open build/docs/site/index.html.

Needs the extra `docs`. build/docs/pages gets the pages of docs/, the generated pages
(environments, methods, reference) and the executed notebooks. Zensical turns them into a site,
whose links, anchors and pictures are checked. `--draft` does not execute the notebooks.
"""

import argparse
import contextlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import generated
from check_site import problems

from eitbench.worlds import entries

ROOT = Path(__file__).resolve().parent.parent
BUILD = ROOT / "build" / "docs"
PAGES = BUILD / "pages"
ELSEWHERE = {
    "CHANGELOG.md": "changes.md",
    "CONTRIBUTING.md": "contributing.md",
    "README.md": "index.md",
    "baselines": "baselines.md",
    "baselines/checkpoints": "injection.md",
    "baselines/injection": "baselines.md",
    "benchmarks/README.md": "speed.md",
    "examples/bubble_tank": "worlds.md",
    "leaderboards/README.md": "leaderboards.md",
    "leaderboards/leaderboard.md": "boards-as-text.md",
    "leaderboards/site": "boards",
    "studies/README.md": "studies.md",
}
"""File or folder outside docs/ -> its page on the site."""


def place(source: Path) -> str:
    """Return the address on the site of a file or folder of the repository."""
    name = source.relative_to(ROOT).as_posix()
    if name in ELSEWHERE:
        return ELSEWHERE[name]
    for folder, there in (("docs/", ""), ("leaderboards/site/", "boards/")):
        if name.startswith(folder):
            return there + name.removeprefix(folder).replace(".ipynb", ".md")
    return f"files/{name.removeprefix('.')}"


def placed(linked: Path) -> str:
    """Return the address on the site of a link target; copy a target that is not a page."""
    page = place(linked)
    if linked.is_file() and not page.endswith(".md"):
        write(page, linked.read_bytes())
    return page


def relative(page: str, source: Path) -> str:
    """Return the relative address of ``page`` from the page of ``source``."""
    return os.path.relpath(page, Path(place(source)).parent)


def staged(source: Path) -> str:
    """A page with links as on the site; files that it links to are copied.

    Drawings become part of the text, so that their colours follow the page's, and ids of
    environments become links. `SystemExit` if a link leads nowhere.
    """
    def linked(match: re.Match[str]) -> str:
        target, sharp, anchor = match[2].partition("#")
        there = (source.parent / target).resolve()
        if not target or "://" in target:
            return match[0]
        if not there.exists():
            raise SystemExit(f"{source.relative_to(ROOT)} links to {target}, which is not there")
        if there.suffix == ".svg":
            return f"<div>\n{there.read_text(encoding='utf-8')}</div>"
        return f"{match[1]}({relative(placed(there), source)}{sharp}{anchor})"

    text = source.read_text(encoding="utf-8")
    parts = re.split(r"(^ *```.*?^ *```$)", text, flags=re.DOTALL | re.MULTILINE)
    for number in range(0, len(parts), 2):
        text = re.sub(r"(!?\[[^]]*\])\(([^)\s]+)\)", linked, parts[number])
        parts[number] = re.sub(r"^(?!#)(.*)$", with_environments, text, flags=re.MULTILINE)
    return "".join(parts)


def staged_boards(source: Path) -> str:
    """A rendered page of the leaderboards with links as on the site to what lies outside them;
    files that it links to are copied."""
    folder = ROOT / "leaderboards" / "site"

    def linked(match: re.Match[str]) -> str:
        there = (source.parent / match[2]).resolve()
        if "://" in match[2] or there.is_relative_to(folder) or not there.is_file():
            return match[0]
        page = re.sub(r"\.md$", ".html", placed(there))
        return f'{match[1]}="{relative(page, source)}"'

    return re.sub(r'\b(href|src|srcset)="([^"#]+)"', linked, source.read_text(encoding="utf-8"))


def with_environments(line: re.Match[str]) -> str:
    """Return the line with links from environment ids to their pages, except in links and for
    measured data, which has no page."""
    def linked(match: re.Match[str]) -> str:
        known = match[1] in entries()
        return f"[{match[0]}](environments/{match[2]}.md)" if known else match[0]

    return re.sub(r"(?<!\[)`(eitbench/(\w+-v\d+))`", linked, line[1])


def write(name: str, content: str | bytes) -> None:
    """Write a file of the staged pages."""
    path = PAGES / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content.encode() if isinstance(content, str) else content)


def main() -> None:
    """Stage, build, check."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draft", action="store_true", help="leave the notebooks unexecuted")
    draft = parser.parse_args().draft
    began = time.perf_counter()
    shutil.rmtree(BUILD, ignore_errors=True)
    if not draft:
        check_readme()
    stage_written()
    configure(stage_generated(execute=not draft))
    print(f"staged in {time.perf_counter() - began:.0f} s")
    built = subprocess.run([sys.executable, "-m", "zensical", "build", "--strict",
                            "--config-file", str(BUILD / "zensical.toml")], check=False)
    found = [] if built.returncode else problems(BUILD / "site")
    if built.returncode or found:
        raise SystemExit("\n".join([*found, "the documentation was not built"]))
    print(f"{BUILD / 'site' / 'index.html'}, in {time.perf_counter() - began:.0f} s")


def stage_written() -> None:
    """Stage the written pages and the leaderboards."""
    sources = [*sorted((ROOT / "docs").glob("*.md")),
               *(ROOT / name for name in ELSEWHERE if name.endswith(".md") and name != "README.md")]
    for source in sources:
        write(place(source), staged(source))
    write("extra.css", (ROOT / "docs" / "extra.css").read_bytes())
    boards = ROOT / "leaderboards" / "site"
    shutil.copytree(boards, PAGES / "boards", dirs_exist_ok=True)
    for source in sorted(boards.rglob("*.html")):
        write(place(source), staged_boards(source))


def stage_generated(*, execute: bool) -> list[str]:
    """Stage environments, methods, reference and notebooks; return the names of their files."""
    pages = generated.environments() | generated.baselines() | generated.reference()
    for source in sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")):
        began = time.perf_counter()
        pages |= generated.notebook(source, execute)
        print(f"{source.name}, {time.perf_counter() - began:.0f} s")
    for name, content in pages.items():
        write(name, content)
    return list(pages)


def configure(pages: list[str]) -> None:
    """Write the site's configuration, with the generated pages in place of each "folder/*"."""
    def listed(match: re.Match[str]) -> str:
        return ", ".join(json.dumps(page) for page in pages
                         if page.startswith(match[1]) and page.endswith(".md"))

    config = (ROOT / "docs" / "zensical.toml").read_text(encoding="utf-8")
    config = re.sub(r'"(\w+/)\*"', listed, config)
    (BUILD / "zensical.toml").write_text(config, encoding="utf-8")


def check_readme() -> None:
    """Raise `SystemExit` unless README's first snippet prints the text in README, up to the last
    digit of a number, whose rounding depends on the processor."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    snippet = re.search(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    said = re.search(r"It prints `([^`]*)`", text)
    assert snippet and said, "README.md must have a snippet, and what it prints"
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(compile(snippet[1], "README.md", "exec"), {})
    numbers = [[float(number) for number in re.findall(r"-?\d+\.\d+", words)]
               for words in (said[1], out.getvalue())]
    if any(abs(a - b) > 1.1e-4 for a, b in zip(*numbers, strict=True)):
        raise SystemExit(f"README.md has {said[1]}, but its snippet prints {out.getvalue()}")


if __name__ == "__main__":
    main()
