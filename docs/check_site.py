"""Check that every link of a built site leads somewhere, and that no page loads from elsewhere."""

from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADED = {"src", "poster", "data", "srcset"}
"""Attributes whose target a browser loads by itself."""


class Page(HTMLParser):
    """The anchors of a page, and the targets that it names."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.targets: list[tuple[str, bool]] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note what the tag is called and what it names."""
        given = {name: value for name, value in attrs if value}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        self.targets += [(given[name], name in LOADED or tag == "link")
                         for name in ("href", *LOADED) if name in given and tag != "base"]


def problems(site: Path) -> list[str]:
    """Return a line for each link, anchor or picture of the pages below ``site`` that is missing,
    and for each file that a page loads from another machine."""
    pages = {path: Page(path) for path in sorted(site.rglob("*.html"))}
    found = []
    for path, page in pages.items():
        for target, loaded in page.targets:
            url = urlsplit(target)
            if url.scheme or url.netloc:
                if loaded and url.scheme != "data":
                    found.append(f"{path.relative_to(site)} loads {target}")
                continue
            base = site if url.path.startswith("/") else path.parent
            there = (base / unquote(url.path).lstrip("/")).resolve() if url.path else path
            if there.is_dir():
                there /= "index.html"
            anchor = unquote(url.fragment)
            if not there.exists():
                found.append(f"{path.relative_to(site)} links to {target}, which is not there")
            elif anchor and there in pages and anchor not in pages[there].anchors:
                found.append(f"{path.relative_to(site)} links to {target}: no such anchor")
    return found
