"""The command `estimate`: what methods make of a record of a real instrument."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import Annotated

import typer

from eitbench.cli import options


def estimate(
    file: Annotated[Path, typer.Argument(
        help="Record: our HDF5, .mat of KTC2023, KIT4 or EIDORS, a folder of Sciospec's .eit, or a "
             "table.")],
    vessel: Annotated[Path, typer.Option(help="YAML file that describes the vessel.")],
    baseline: Annotated[list[str], typer.Option(
        "--baseline", help="Method, by name or path; may be repeated. The first is drawn.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Page to write.")] = Path("report.html"),
    arrays: Annotated[Path | None, typer.Option(
        help="File for all of the first method's estimates too, npz; they are kept in memory till "
             "then.")] = None,
    format: Annotated[str | None, typer.Option(
        help="hdf5, ktc, eidors, sciospec or table. Default: what the file tells.")] = None,
    withheld: Annotated[float, typer.Option(
        min=0.0, max=0.5, help="Part of the readings that methods are not shown and are judged "
                               "by.")] = 0.1,
    span: Annotated[str | None, typer.Option(
        help="Only readings FIRST:LAST, counted from 0, the last not among them.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Which readings those are.")] = 0,
    truth: Annotated[Path | None, typer.Option(
        help="What was in a round tank, as KTC has it: variable truth of a .mat file, 256 × 256 "
             "pixels 0 (water), 1 (conducts worse), 2 (better).")] = None,
    still: Annotated[bool, typer.Option("--still", help="The target does not move.")] = False,
    correction: Annotated[str, typer.Option(
        help="What becomes of what the model of homogeneous fluid is off: offset or gain.")]
    = "offset",
    homogeneous_frames: Annotated[int, typer.Option(
        min=1, help="First frames that are homogeneous fluid, where there is no reference.")] = 1,
) -> None:
    """Estimate what an instrument saw in a tank or pipe: calibrates the vessel, plays methods, and
    writes a page with the estimates, how well they predict readings that they were not shown,
    and what is odd about the record."""
    from eitbench.bench.measured import pages_steps, play_record
    from eitbench.bench.segmentation import (
        check_tank,
        distances,
        ktc_score,
        read_truth,
        segmented,
    )
    from eitbench.data.measured import read
    from eitbench.envs.measured import MeasuredEnv
    from eitbench.report.measured import write_report
    with options.clear_errors():
        if out.suffix != ".html":
            raise ValueError(f"--out must end in .html, got {out}")
        record = read(file, format, None if span is None else _steps(span))
        options.say(f"{file}: {len(record.readings)} times {len(record.matrix)} readings of "
                    f"{record.currents.shape[1]} electrodes; a method takes about "
                    f"{10 + 0.03 * len(record.readings):.0f} s")
        env = MeasuredEnv(record, vessel, withheld=withheld, moves=False if still else None,
                          correction=correction, homogeneous_frames=homogeneous_frames)
        picture = None if truth is None else read_truth(truth)
        if picture is not None:
            check_tank(env)
        doubts = env.doubts()
        for doubt in doubts:
            options.say(f"odd: {doubt}", err=True)
        played = []
        for name in baseline:
            kept = pages_steps(env) if arrays is None else None
            played.append(play_record(env, name, seed, kept=kept))
            options.say(f"{played[-1].method}: withheld readings missed by "
                        f"{played[-1].withheld:.2f} noise std")
            if played[-1].velocity is not None:
                said = ", ".join(f"{each:.3g}" for each in played[-1].velocity[-1])
                options.say(f"  mean velocity at the end {said} m/s")
            if picture is not None:
                found = segmented(env, played[-1].mean[-1])
                options.say(f"  KTC's score {ktc_score(picture, found):.3f}; "
                            f"{_said_of(distances(env, picture, found))}")
        write_report(out, env, played, record.source, doubts, picture)
        options.say(f"wrote {out}")
        if arrays is not None:
            played[0].save(arrays, env)
            options.say(f"wrote {arrays}")


def _steps(span: str) -> slice:
    """``0:800``"""
    first, colon, last = span.partition(":")
    if not (colon and first.isdigit() and (last.isdigit() or not last)):
        raise ValueError(f"--span must be two numbers such as 0:800, got {span!r}")
    return slice(int(first), int(last) if last else None)


def _said_of(distances: list[float]) -> str:
    """How far a picture's bodies are off, in m, infinite of one that it does not show."""
    shown = [f"{100 * each:.2f}" for each in distances if isfinite(each)]
    missing = len(distances) - len(shown)
    if not shown:
        return "it shows none of the bodies"
    said = f"its bodies are off by {', '.join(shown)} cm"
    return f"{said}; of {missing} it shows nothing" if missing else said
