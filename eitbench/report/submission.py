"""Whether a submission may be merged: what a pull request adds to ``leaderboards/``, looked at by
the code of those who receive it. Nothing of the submission is imported; its methods play in guests.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from eitbench._foreign import as_markdown
from eitbench.bench import held_out
from eitbench.bench.contradictions import version_number
from eitbench.bench.measured_records import read_measured_record
from eitbench.bench.podium import file_of
from eitbench.bench.records import read_record
from eitbench.bench.sandbox.host import GuestError
from eitbench.bench.tracks import ids
from eitbench.bench.verify import empty_cache, job_of, verify
from eitbench.data.seasons import current_season
from eitbench.report.boards import read_for_boards
from eitbench.report.site import Beside, Measured, collect, render, render_site

RENDERED = ("leaderboard.csv", "leaderboard.md", "site")
"""What `eitbench leaderboard` writes beside the records."""
ADDED = ("results", "measured", "methods", "media")
"""Folders to which a submission adds files."""
METHOD = 10_000_000
"""bytes of a method's file, at most"""


class Asked(NamedTuple):
    """How a submission is checked."""

    episodes: int = 1
    """Of each record, played again."""
    seed: int = 0
    """By which they are drawn."""
    held_out: int = 0
    """Held-out episodes of each method; none without a salt."""
    salt: bytes = b""
    official: bool = False
    """Whether records may call themselves official."""


class Finding(NamedTuple):
    """What one step of the check has found."""

    what: str
    said: str
    """Markdown; may be empty."""
    problems: list[str]


def check(submitted: Path, ours: Path, asked: Asked) -> Iterator[Finding]:
    """Step by step: files, then each record that is new or changed, then the rendered pages.

    Parameters
    ----------
    submitted, ours : path
        The folder ``leaderboards`` of the submission, and the one it is to be merged into.
    asked
        What is played.

    Raises
    ------
    ValueError
        If one of them is no folder of leaderboards.
    """
    for name, folder in (("submitted", submitted), ("against", ours)):
        if not (folder / "results").is_dir():
            raise ValueError(f"{name} must be a folder leaderboards with a folder results in it, "
                             f"got {folder}")
    files = _files(submitted, ours)
    yield files
    if files.problems:                                # links lead anywhere: nothing more is read
        return
    changed = [path for path in _changed(submitted / "results", ours / "results")
               if path.suffix == ".json"]
    with empty_cache():
        for path in tqdm(changed, desc="checking records", unit="record", disable=None):
            yield _record(path, ours / "results" / path.name, submitted / "methods", asked)
    if measured := _changed(submitted / "measured", ours / "measured"):
        yield _measured(measured, ours / "measured", asked)
    yield _pages(submitted)


def markdown(findings: list[Finding]) -> str:
    """The report: what is wrong first, then what was seen."""
    problems = [(finding.what, problem) for finding in findings for problem in finding.problems]
    parts = ["# Check of a submission"]
    if problems:
        parts += [f"**Not to be merged: {len(problems)} problem{'s' * (len(problems) > 1)}.**",
                  "\n".join(f"- {as_markdown(what)}: {as_markdown(problem)}"
                            for what, problem in problems)]
    else:
        parts.append("**Nothing speaks against it.**")
    for finding in findings:
        said = finding.said or ("see above" if finding.problems else "fine")
        parts += [f"## {as_markdown(finding.what)}", said]
    return "\n\n".join(parts) + "\n"


def _files(submitted: Path, ours: Path) -> Finding:
    """Nothing is removed, nothing but records, methods, animations and rendered files changes."""
    there = {path.relative_to(submitted): path for path in sorted(submitted.rglob("*"))
             if path.is_symlink() or not path.is_dir()}
    here = {path.relative_to(ours): path for path in ours.rglob("*") if path.is_file()}
    problems = []
    added = []
    for name, path in there.items():
        first = name.parts[0]
        if path.is_symlink() or not path.is_file():
            problems.append(f"{name} must be a file, no link")
        elif first in RENDERED:
            continue
        elif first not in ADDED:
            if _content(ours / name) != path.read_bytes():
                problems.append(f"{name} is none of the files that a submission changes")
        elif name not in here:
            added.append(name)
            if first == "methods" and path.stat().st_size > METHOD:
                problems.append(f"{name} must be of {METHOD / 1e6:g} MB at most")
        elif first == "methods" and path.read_bytes() != here[name].read_bytes():
            problems.append(f"{name} is there already with another content; give it a folder of "
                            "its own")
    problems += [f"{name} was removed" for name in here
                 if name not in there and name.parts[0] not in RENDERED]
    said = "\n".join(f"- {as_markdown(str(name))}" for name in added)
    return Finding("Files", said and f"New:\n\n{said}", problems)


def _record(path: Path, earlier: Path, methods: Path, asked: Asked) -> Finding:
    """One record: format, seal and name; what it replaces; who made it; its episodes again."""
    try:
        record = read_record(path)
        problems = [*_of_the_record(record, asked), *_lost(record, earlier)]
        job = job_of(record, file_of(record, methods), "always")
        table, differences = verify(record, job, episodes=asked.episodes, seed=asked.seed)
        said = [f"Isolation: {job.isolation}. Played again:", table]
        problems += differences
        if asked.held_out:
            todo = held_out.plays(record, job, asked.salt, asked.held_out)
            table, differences = held_out.held_out(record, todo)
            said += ["Held-out episodes:", table]
            problems += differences
    except (ValueError, GuestError) as error:
        return Finding(path.name, "", [str(error)])
    return Finding(path.name, "\n\n".join(said), problems)


def _of_the_record(record: dict[str, Any], asked: Asked) -> Iterator[str]:
    split = current_season().split
    if record["environment"]["id"] not in ids():
        yield f"there is no environment {record['environment']['id']} here"
    if record["split"] != split:
        yield f"its seeds must be of the season's split {split}, got {record['split']}"
    if record["official"] and not asked.official:
        yield "it calls itself official, which only the maintainers' records are"
    if record["official"] and version_number(record["version"]) is None:
        yield "it calls itself official, and its method is none of ours"


def _measured(changed: list[Path], ours: Path, asked: Asked) -> Finding:
    """Records of the measured board, whose data are not here: nothing is played again."""
    problems = []
    for path in changed:
        earlier = ours / path.name
        if path.suffix != ".json":
            if earlier.exists():
                problems.append(f"{path.name} is there already with another content; records are "
                                "of the case as it was")
            continue
        try:
            record = read_measured_record(path)
            if record["official"] and not asked.official:
                problems.append(f"{path.name} calls itself official, which only the maintainers' "
                                "records are")
            if earlier.exists() and read_measured_record(earlier)["official"]:
                problems.append(f"{path.name} replaces an official record")
        except ValueError as error:
            problems.append(f"{path.name} {error}")
    names = "\n".join(f"- {as_markdown(path.name)}" for path in changed)
    return Finding("Measured data", "Not played again, `eitbench verify RECORD --data FILE` does "
                                    f"that where the data are:\n\n{names}", problems)


def _changed(submitted: Path, ours: Path) -> list[Path]:
    """Files of a folder that are new or others."""
    return [path for path in sorted(submitted.glob("*"))
            if path.is_file() and _content(ours / path.name) != path.read_bytes()]


def _lost(record: dict[str, Any], earlier: Path) -> Iterator[str]:
    """What the record that it replaces says and it does not."""
    if not earlier.exists():
        return
    before = read_record(earlier)
    now = {episode["seed"]: _said(episode) for episode in record["episodes"]}
    for episode in before["episodes"]:
        if now.get(episode["seed"]) != _said(episode) and episode["status"] == "ok":
            yield f"{episode['seed']} was recorded before, and is missing or another now"
    if before["official"] and not record["official"]:
        yield "it replaces an official record"


def _said(episode: dict[str, Any]) -> str:
    """All but its run's place in the record."""
    return json.dumps({key: value for key, value in episode.items() if key != "run"},
                      sort_keys=True)


def _pages(submitted: Path) -> Finding:
    """Whether the rendered files are those of the records."""
    try:
        records, complaints = read_for_boards(submitted / "results")
        site = collect(records)
        measured = Measured.of(submitted)
        texts = {name: text.encode() for name, text in render(site, measured).items()}
        pages = render_site(site, Beside.of(submitted, submitted / "site"), measured)
    except ValueError as error:
        return Finding("Rendered pages", "", [str(error)])
    made = texts | {f"site/{name}": content for name, content in pages.items()}
    there = {path.relative_to(submitted).as_posix() for name in RENDERED
             for path in [submitted / name, *(submitted / name).rglob("*")] if path.is_file()}
    old = sorted(name for name in there | set(made)
                 if _content(submitted / name) != made.get(name))
    problems = [*complaints, *measured.complaints]
    if old:
        shown = ", ".join(old[:5]) + (f" and {len(old) - 5} more" if len(old) > 5 else "")
        problems.append(f"out of date: {shown}; `eitbench leaderboard --records "
                        "leaderboards/results` renders them")
    return Finding("Rendered pages", "", problems)


def _content(path: Path) -> bytes | None:
    return path.read_bytes() if path.is_file() else None
