"""Third-party text in records is escaped on every page; damaged records are named and ignored."""

import re

import pytest
from eitbench._sanitize import sanitize
from eitbench.bench.records import read_records, with_content_hash, write_record
from eitbench.bench.store import EpisodeStore
from eitbench.bench.tracks import environment_name
from eitbench.report.boards import run_leaderboards
from eitbench.report.page import write_page
from eitbench.report.site import collect, render, render_site
from pages import Page

from commands import eitbench
from tiny import BOARD_IDS, RUN, record

TEXTS = ["<script>alert(1)</script>", "<b onmouseover=alert(1)>", "\"'><img src=http://x>", "| a | b |", "{{ 7*7 }}",
         "{% raw %}", "[a](http://x)", "](http://x)", "`<b>`", "&lt;b&gt;", "--><b>", "]]><b>", "\x1b[2J", "\u202eevil",
         "a\u2028b", "\u200bz", "=1+1"]
UNSEEN = r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2066-\u2069]"


def hostile(text):
    """Return records with a text in each field of text: title, parameters, message, command, machine, arguments."""
    id = BOARD_IDS["filter"]
    given = {"assume": {text: text}}
    machine = RUN["machine"] | {"processor": text}
    odd = record("odd", [0.2, 0.1, None], title=text, parameters={text: text}, runs=[RUN | {
        "command": text, "machine": machine}], environment={
            "id": id, "name": environment_name(id, given), "kwargs": given})
    plain = record("plain", [0.1, 0.2, 0.1], title=text)
    for episode in odd["episodes"]:
        if episode["status"] != "ok":
            episode |= {"message": text, "where": text}
    return [with_content_hash(odd), plain, record("homogeneous", [0.2, 0.3, 0.2], role="floor")]


@pytest.mark.parametrize("text", TEXTS)
def test_text_stays_text(text, tmp_path):
    """Site, HTML report and Markdown contain no tag, link or hidden character of the text."""
    records = hostile(text)
    site = collect(records)
    pages = {path: content.decode() for path, content in render_site(site).items() if path.endswith(".html")}
    pages["results"] = write_page(EpisodeStore(tmp_path), run_leaderboards(records)).read_text(encoding="utf-8")
    for path, page in pages.items():
        parsed = Page(page)
        assert not re.search(UNSEEN, page), path
        assert all("onmouseover" not in attributes for _, attributes in parsed.tags)
        assert not any("http://x" in address for name in ("src", "href") for address in parsed.attributes(name))
        assert [tag for tag, _ in parsed.tags].count("script") == 1 and "49" not in re.findall(r">(49)<", page)
        assert not re.search(r"<b>\s*[^\d−-]", page), path
    assert sanitize(text) in "".join(Page(pages["methods/odd.html"].replace("<wbr/>", "")).text)
    texts = render(site)
    markdown = texts["leaderboard.md"]
    assert not re.search(UNSEEN, markdown)
    assert not re.search(r"(?<!\\)<(script|b|img)\b|(?<!\\)\]\(http://x", markdown)
    for block in re.findall(r"(?:^\|.*\n)+", markdown, flags=re.MULTILINE):
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in block.splitlines()}) == 1
    if text == "=1+1":                                        # a spreadsheet would evaluate it
        assert ",'=1+1," in texts["leaderboard.csv"]


def content(folder):
    """Map the path of each file to its bytes."""
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_damaged_records_are_named_and_change_nothing(tmp_path):
    """Damaged records lead to exit status 1, and the other files are as without them."""
    for name in ("alone", "among"):
        for each in (record("homogeneous", [0.2, 0.3], role="floor", official=True), record("mine", [0.1, 0.2])):
            write_record(tmp_path / name / "results", each)
    for name in ("x.json", "\x1b[2J\u202e.json"):
        (tmp_path / "among" / "results" / name).write_text("{")
    write_record(tmp_path / "among" / "results", record("mine", {"dev:0": 0.1}))
    assert eitbench("leaderboard", "--records", tmp_path / "alone" / "results")[0] == 0
    code, _, complaint = eitbench("leaderboard", "--records", tmp_path / "among" / "results")
    assert code == 1 and complaint.count("left out: record") == 3
    assert "x.json cannot be read" in complaint and "\\x1b[2J\\u202e.json cannot" in complaint
    assert "--dev.json has dev seeds" in complaint
    others = ("results", "episodes.csv.xz")                            # the table has dev episodes too
    alone, among = ({path: data for path, data in content(tmp_path / name).items() if path.parts[0] not in others}
                    for name in ("alone", "among"))
    assert alone == among and len(alone) > 5
    with pytest.raises(ValueError, match=r"x\.json cannot be read"):
        read_records(tmp_path / "among" / "results")


@pytest.mark.parametrize("left", ["", "x.json", "notes.txt"])
def test_a_folder_without_records_deletes_nothing(left, tmp_path):
    """A missing folder, or one with damaged records only, leads to exit status 2 without changes."""
    write_record(tmp_path / "results", record("homogeneous", [0.2, 0.3], role="floor"))
    assert eitbench("leaderboard", "--records", tmp_path / "results")[0] == 0
    (wrong := tmp_path / "result").mkdir()
    if left:
        (wrong / left).write_text("{")
    before = content(tmp_path)
    code, said, complaint = eitbench("leaderboard", "--records", wrong)
    assert code == 2 and said == "" and "records must be a folder with records" in complaint
    assert ("x.json cannot be read" in complaint) == (left == "x.json")
    assert content(tmp_path) == before
