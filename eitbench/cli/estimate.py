"""Commands `estimate` and `fetch`: measurements of real instruments."""

from __future__ import annotations

import re
from math import isfinite
from pathlib import Path
from typing import Annotated

import typer

from eitbench.cli import options


def estimate(
    file: Annotated[Path, typer.Argument(
        help="Measurements: eitbench HDF5, .mat of KTC2023, KIT4 or EIDORS, a folder of "
             "Sciospec's .eit, or a table.")],
    vessel: Annotated[Path, typer.Option(help="YAML file that describes the vessel.")],
    baseline: Annotated[list[str], typer.Option(
        "--baseline", help="Estimator name or path; may be repeated. The first is drawn.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="HTML report.")] = Path("report.html"),
    arrays: Annotated[Path | None, typer.Option(
        help="Also write all estimates of the first method, kept in memory, as npz.")] = None,
    format: Annotated[str | None, typer.Option(
        help="hdf5, ktc, eidors, sciospec or table. Default: detected.")] = None,
    option: Annotated[list[str] | None, typer.Option(
        "--option", help="Argument NAME=VALUE of the file's reader, such as reference=VARIABLE "
                         "(EIDORS) or frequency=1e4 (Sciospec); may be repeated.")] = None,
    withheld: Annotated[float, typer.Option(
        min=0.0, max=0.5, help="Fraction of the measurements withheld from the methods; their "
                               "residuals are the score.")] = 0.1,
    span: Annotated[str | None, typer.Option(
        help="Only time steps FIRST:LAST, counted from 0, LAST excluded.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Random seed of withheld measurements.")] = 0,
    truth: Annotated[Path | None, typer.Option(
        help="Ground truth in a round tank, in the format of KTC: variable truth of a .mat file, "
             "256 × 256 pixels 0 (water), 1 (resistive), 2 (conductive).")] = None,
    still: Annotated[bool, typer.Option("--still", help="The target is stationary.")] = False,
    correction: Annotated[str, typer.Option(
        help="Correction of the misfit on homogeneous fluid: subtract an offset or divide by a "
             "channel gain (offset or gain), or none for absolute images.")] = "offset",
    homogeneous_frames: Annotated[int, typer.Option(
        min=1, help="Number of initial frames that replace a missing reference frame.")] = 1,
) -> None:
    """Estimate the concentration in a real tank or pipe: calibrate the vessel, run methods, and
    write a report with estimates, residuals of withheld measurements and data-quality warnings."""
    from eitbench.bench.measured import plotted_steps
    from eitbench.bench.runner import run_on_measurements
    from eitbench.envs.measured import MeasuredEnv
    from eitbench.measured import read
    from eitbench.measured.segmentation import read_truth, require_round_tank
    from eitbench.report.measured import write_report
    if out.suffix != ".html":
        raise ValueError(f"--out must end in .html, got {out}")
    measurements = read(file, format, None if span is None else _steps(span),
                        **_reader_options(option or []))
    T, M = measurements.voltages.shape
    options.echo(f"{file}: {T} × {M} measurements, {measurements.currents.shape[1]} "
                f"electrodes; a method takes about {10 + 0.03 * T:.0f} s")
    env = MeasuredEnv(measurements, vessel, withheld=withheld, moves=False if still else None,
                      correction=correction, homogeneous_frames=homogeneous_frames)
    mask = None if truth is None else read_truth(truth)
    if mask is not None:
        require_round_tank(env.vessel)
    for warning in env.quality_warnings():
        options.echo(f"warning: {warning}", err=True)
    runs, kept = [], plotted_steps(env) if arrays is None else None
    for name in baseline:
        try:
            run = run_on_measurements(env, name, seed, kept=kept)
        except Exception as error:
            raise ValueError(f"{name} failed: {type(error).__name__}: {error}") from error
        runs.append(run)
        score = ("no measurement is withheld, so nothing is scored" if not env.withheld
                 else f"withheld RMSE {run.withheld_rmse:.2f} noise std, "
                      f"{1e3 * run.withheld_rmse_volts:.3g} mV")
        options.echo(f"{run.method}: {score}")
        if run.velocity is not None:
            velocity = ", ".join(f"{each:.3g}" for each in run.velocity[-1])
            options.echo(f"  mean velocity at the end {velocity} m/s")
        if mask is not None:
            options.echo(f"  {_truth_scores(env, run, mask)}")
    write_report(out, env, runs, mask)
    options.echo(f"wrote {out}")
    if arrays is not None:
        runs[0].save(arrays, env)
        options.echo(f"wrote {arrays}")


def fetch(
    cases: Annotated[list[str], typer.Argument(
        help="Names of measured cases, such as iirc of eitbench/Measured-iirc-v0, or YAML files.")],
) -> None:
    """Download the public measurements of cases, and check their sha256."""
    from eitbench.measured.cases import download_case, measured_folder, read_case
    for case in [read_case(name) for name in cases]:
        options.echo(f"{case.name}: {case.title} (licence: {case.licence})")
        for path in download_case(case):
            options.echo(f"  wrote {path}")
        options.echo(f"  complete in {measured_folder()}")


def _reader_options(texts: list[str]) -> dict[str, float | str]:
    """Parse ``NAME=VALUE``; numbers are converted."""
    parsed: dict[str, float | str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name.isidentifier():
            raise ValueError(f"--option must be NAME=VALUE, got {text!r}")
        try:
            parsed[name] = int(value) if value.isdigit() else float(value)
        except ValueError:
            parsed[name] = value
    return parsed


def _steps(span: str) -> slice:
    """Parse a span such as ``0:800``."""
    ends = re.fullmatch(r"(\d+):(\d*)", span)
    if ends is None or (ends[2] and int(ends[2]) <= int(ends[1])):
        raise ValueError(f"--span must be two increasing numbers such as 0:800, got {span!r}")
    return slice(int(ends[1]), int(ends[2]) if ends[2] else None)


def _truth_scores(env, run, truth) -> str:  # type: ignore[no-untyped-def]
    """Describe the KTC score and the centroid errors of the last estimate."""
    from eitbench.measured.segmentation import centroid_errors, ktc_score, segment
    found = segment(env.vessel, env.task, run.mean[-1])
    errors = centroid_errors(env.vessel, truth, found)
    shown = [f"{100 * each:.2f}" for each in errors if isfinite(each)]
    centroids = f"centroid errors {', '.join(shown)} cm; " if shown else ""
    return (f"KTC score {ktc_score(truth, found):.3f}; {centroids}{len(errors) - len(shown)} of "
            f"{len(errors)} inclusions missing")
