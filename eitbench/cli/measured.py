"""The command `submit-measured`: records of the measured board."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from eitbench.cli import options


def submit_measured(
    case: Annotated[Path, typer.Argument(
        help="YAML file of the case, such as leaderboards/measured/iirc.yml.")],
    data: Annotated[Path, typer.Option(
        help="The record's file or folder; the case says where it can be had.")],
    baseline: Annotated[list[str], typer.Option(
        help="Name of one of ours, or the path of your own .py file; may be repeated.")],
    truth: Annotated[Path | None, typer.Option(
        help="Of a case that has one: the file of the truth.")] = None,
    to: Annotated[Path | None, typer.Option(
        help="Folder of the records. Default: that of the case.")] = None,
    official: Annotated[bool, typer.Option(
        "--official", help="For maintainers: a run of theirs.")] = False,
) -> None:
    """Play a record of a real instrument with one or more baselines and write records for the
    measured board.

    Each is played five times with other readings withheld; the same command again resumes. Methods
    run in this process: play only files that you trust.
    """
    from eitbench.bench.measured_cases import SEEDS, read_case
    from eitbench.bench.measured_records import read_measured_record
    from eitbench.bench.measured_records import submit_measured as submit
    with options.clear_errors():
        read = read_case(case)
        options.say(f"{read.title}: {len(baseline)} × {len(SEEDS)} plays")
        for name in baseline:
            path = submit(read, data, name, to or case.parent, truth=truth,
                          official=official)
            plays = read_measured_record(path)["plays"]
            missed = sum(play["withheld"] for play in plays) / len(plays)
            options.say(f"wrote {path}: withheld readings missed by {missed:.2f} noise std")
