"""Command `run`: run methods, print the table and write the HTML report."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from eitbench.cli import options

if TYPE_CHECKING:
    from eitbench.bench.run import Job

Suite = StrEnum("Suite", ["quick", "full"])


def run(
    suite: Annotated[Suite, typer.Option(
        help="Preset of environments and seeds if --env or --seeds is missing. quick: the 2D "
             "pipe, test:0-3, four minutes on two cores; full: every estimation environment, "
             "more seeds, also slow methods.")] = Suite.quick,
    env: options.Environments = None,
    baseline: Annotated[list[str] | None, typer.Option(
        help="Name of a built-in estimator, or path of a .py file; may be repeated. Default: "
             "all built-in estimators.")] = None,
    policy: Annotated[list[str] | None, typer.Option(
        help="Name of a built-in injection policy, or path of a .py file or of an agent's "
             "model.zip; needs --env; may be repeated. Default in injection environments: all "
             "built-in policies.")] = None,
    seeds: Annotated[str | None, typer.Option(
        help="Episode seeds, e.g. dev:0-9 or test:3. Default: seeds of the suite.")] = None,
    settings: Annotated[list[str] | None, typer.Option(
        "--set", help="Change a number of the world, e.g. instrument.noise_relative=0.02; may be "
                      "repeated. Several values, e.g. 0.01,0.02,0.05, are run one after the "
                      "other, with a table and a chart in the HTML report.")] = None,
    estimator: Annotated[str, typer.Option(
        help="Kalman filter inside injection environments. full: all nodes, for scores; reduced: "
             "about a hundred modes, as in training.")] = "full",
    isolate: options.Isolate = options.Isolation.auto,
    jobs: options.Jobs = options.CORES,
    backend: options.Backends = options.Backend.loky,
    out: options.Out = Path("results"),
    records: Annotated[Path | None, typer.Option(
        callback=options.resolve_path,
        help="For policies: folder of records, such as leaderboards/results. Episodes in them are "
             "not rerun; their scores are included in the table.")] = None,
) -> None:
    """Run estimators or injection policies, print the table and write the HTML report.

    Each episode is stored when it finishes; the same command resumes an interrupted run. The table
    shows this run, the report OUT/index.html all results in OUT. The normalised adaptivity gap is
    printed below tables of policies.

    Exit status 1 if all episodes of a method failed.
    """
    from eitbench.bench.run import make_jobs, pending_jobs, run_jobs, successful_results
    from eitbench.bench.store import EpisodeStore, folder_results
    from eitbench.bench.variants import variants
    track = _track_of(env or [], baseline, policy)
    if records is not None and not records.is_dir():
        raise ValueError(f"--records must be a folder, got {records}")
    worlds = variants(settings or [])
    todo = make_jobs(track, env or [], (baseline or policy or []),
                     options.parse_episodes(seeds), suite=suite, estimator=estimator,
                     isolate=isolate, worlds=worlds)
    before = folder_results(records) if records else []
    store = EpisodeStore(out)
    run_jobs(pending_jobs(todo, before), store, n_jobs=jobs, backend=backend,
             command=command_line())
    print_report(out, todo, worlds, before)
    done = {job.method for job in successful_results(todo, [*before, *store.results()])}
    if lost := dict.fromkeys(job.load().name for job in todo if job.method not in done):
        options.echo(f"all episodes failed for {', '.join(lost)}", err=True)
        raise typer.Exit(1)


def _track_of(env: list[str], baseline: list[str] | None, policy: list[str] | None) -> str:
    """Return the track of a run; ``ValueError`` if its arguments belong to both."""
    from eitbench.bench.tracks import track_of
    tracks = {track_of(id) for id in env}
    if baseline:
        tracks.add("estimation")
    if policy:
        tracks.add("injection")
    if len(tracks) > 1:
        raise ValueError("one run must be of estimators or of injection policies, got "
                         f"{', '.join([*env, *(baseline or []), *(policy or [])])}")
    if policy and not env:
        raise ValueError("env must be given with policy")
    return tracks.pop() if tracks else "estimation"


def print_report(out: Path, asked: Sequence[Job] = (), worlds: Sequence[dict[str, Any]] = ({},),
           before: Sequence[dict[str, Any]] = ()) -> None:
    """Print the table of the given jobs (default: of all results in the folder) and write
    Markdown and HTML report of all results; for several ``worlds`` that differ in a number, print
    the errors as a function of it. ``before`` are results of records, which the table includes."""
    from eitbench._files import write_atomically
    from eitbench.bench.store import EpisodeStore
    from eitbench.report.boards import anchors, bundled_anchors, run_leaderboards
    from eitbench.report.page import failures, select_requested, write_page
    from eitbench.report.policies import gap_text, policy_rows
    from eitbench.report.sweep import sweeps, swept_parameter
    from eitbench.report.tables import markdown, terminal_tables
    store = EpisodeStore(out)
    records = store.write_records()
    if not records and not before:
        raise typer.BadParameter(f"no results in {out}; create some with `eitbench run`")
    known = {**bundled_anchors(), **anchors(records)}
    boards = run_leaderboards(records, known)
    write_atomically(out / "leaderboard.md", markdown(boards).encode())
    told = select_requested(store.records(before), asked) if asked else records
    number = swept_parameter(worlds)
    found = sweeps(told, number) if number else []
    width = options.table_width()
    options.echo("\n\n".join(each.text(width) for each in found) if found
                else terminal_tables(run_leaderboards(told, known), width))
    for name in dict.fromkeys(job.environment.name for job in asked):
        jobs = [job for job in asked if job.environment.name == name]
        if gap := gap_text(policy_rows(jobs, [*before, *store.results()])):
            options.echo(f"\n{name}: {gap}")
    failed = failures(store, told)
    for failure in failed:
        options.echo(failure, err=True)
    if failed and any(job.isolation != "none" for job in asked):
        options.echo(f"with --seeds {failed[0].seeds[0]} --isolate none --jobs 1 the method runs "
                     "in this process, where breakpoint() stops", err=True)
    write_page(store, boards, found)
    options.echo(f"\nwrote {out / 'index.html'}")


def command_line() -> str:
    """Return the command with its arguments."""
    return shlex.join(["eitbench", *sys.argv[1:]])
