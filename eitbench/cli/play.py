"""The commands `run` and `policies`: play methods, and say what came out."""

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
    from eitbench.bench.store import EpisodeStore

Suite = StrEnum("Suite", ["quick", "full"])


def run(
    suite: Annotated[Suite, typer.Option(
        help="quick: the 2D pipe, test:0-3, four minutes on two cores; full: every environment, "
             "more seeds, methods that take long.")] = Suite.quick,
    env: Annotated[list[str] | None, typer.Option(
        help="Environment id; may be repeated. Default: suite's.")] = None,
    baseline: Annotated[list[str] | None, typer.Option(
        help="Name of one of ours, or the path of your own .py file; may be repeated. Default: "
             "all of ours.")] = None,
    seeds: Annotated[str | None, typer.Option(
        help="Episodes, as in dev:0-9 or test:3. Default: the suite's.")] = None,
    settings: Annotated[list[str] | None, typer.Option(
        "--set", help="Change a number of the world, as in instrument.noise_relative=0.02; may be "
                      "repeated. Several values, as in 0.01,0.02,0.05, are played one after the "
                      "other, with a table and a chart on the page.")] = None,
    isolate: options.Isolate = options.Isolation.auto,
    jobs: options.Jobs = options.CORES,
    backend: options.Backends = options.Backend.loky,
    out: options.Out = Path("results"),
) -> None:
    """Run baselines on environments, print the table and write the page.

    Each episode is stored the moment it is done; the same command again resumes where it was
    interrupted. The table is of what was asked for, the page of all that the folder holds.

    Exit status 1 if a baseline finished none of its episodes.
    """
    from eitbench.bench import suites
    from eitbench.bench.run import run_jobs
    from eitbench.bench.store import EpisodeStore
    from eitbench.bench.variants import variants
    with options.clear_errors():
        worlds = variants(settings or [])
        todo = suites.jobs("estimation", env or [], baseline or [], options.numbers(seeds),
                           suite=suite, isolate=isolate, worlds=worlds)
        store = EpisodeStore(out)
        run_jobs(todo, store, n_jobs=jobs, backend=backend, command=typed())
        report(out, todo, worlds)
        _end_if_lost(todo, store)


def policies(
    env: options.InjectionId,
    policy: Annotated[list[str] | None, typer.Option(
        help="Name of one of ours, the path of your own .py file, or of an agent's model.zip; may "
             "be repeated. Default: all of ours.")] = None,
    seeds: Annotated[str | None, typer.Option(
        help="Episodes, such as dev:0-49. Default: those of the boards.")] = None,
    estimator: Annotated[str, typer.Option(
        help="full: the exact filter, for scores; reduced: that of training.")] = "full",
    isolate: options.Isolate = options.Isolation.auto,
    jobs: options.Jobs = options.CORES,
    backend: options.Backends = options.Backend.loky,
    out: options.Out = Path("results"),
    records: Annotated[Path | None, typer.Option(
        callback=options.found,
        help="Folder of records, such as leaderboards/results: what they hold of these episodes is "
             "not played again.")] = None,
) -> None:
    """Play injection policies, print their scores and the environment's adaptivity gap.

    Each episode is stored the moment it is done; the same command again resumes.

    Exit status 1 if a policy finished none of its episodes.
    """
    if records is not None and not records.is_dir():
        raise typer.BadParameter(f"--records must be a folder, got {records}")
    from eitbench.bench.run import run_jobs, unplayed
    from eitbench.bench.store import EpisodeStore, results_in
    from eitbench.bench.suites import jobs as jobs_of
    from eitbench.report.policies import policy_rows, policy_table
    from eitbench.report.terminal import asked_of, width
    with options.clear_errors():
        todo = jobs_of("injection", [env], policy or [], options.numbers(seeds),
                       estimator=estimator, isolate=isolate)
        before = results_in(records) if records else []
        store = EpisodeStore(out)
        left = unplayed(todo, before)
        run_jobs(left, store, n_jobs=jobs, backend=backend, command=typed())
    privileged = {job.load().name for job in todo if job.load().privileged}
    rows = policy_rows(todo, [*before, *store.results()])
    options.say(policy_table(rows, sorted(privileged), width()))
    _say_failures(store, asked_of(store.write_records(), left), left)
    _end_if_lost(todo, store, before)


def report(out: Path, asked: Sequence[Job] = (), worlds: Sequence[dict[str, Any]] = ({},)) -> None:
    """Print the table of what was ``asked`` for (default: of all that the folder holds) and write
    Markdown and page of all; of several ``worlds`` that differ in a number, how errors follow
    it."""
    from eitbench._files import write_atomically
    from eitbench.bench.store import EpisodeStore
    from eitbench.report.boards import anchors, run_boards, shipped_anchors
    from eitbench.report.page import write_page
    from eitbench.report.sweep import sweep_text, sweeps, swept
    from eitbench.report.terminal import asked_of, markdown, terminal_tables, width
    store = EpisodeStore(out)
    records = store.write_records()
    if not records:
        raise typer.BadParameter(f"no results in {out}; make some with `eitbench run`")
    known = {**shipped_anchors(records), **anchors(records)}
    boards = run_boards(records, known)
    write_atomically(out / "leaderboard.md", markdown(boards).encode())
    told = asked_of(records, asked) if asked else records
    number = swept(worlds)
    found = sweeps(told, number) if number else []
    options.say("\n\n".join(sweep_text(each, width()) for each in found) if found
                else terminal_tables(run_boards(told, known), width()))
    _say_failures(store, told, asked)
    write_page(store, boards, found)
    options.say(f"\nwrote {out / 'index.html'}")


def typed() -> str:
    """The command."""
    return shlex.join(["eitbench", *sys.argv[1:]])


def _say_failures(store: EpisodeStore, records: list[dict[str, Any]],
                  asked: Sequence[Job]) -> None:
    """What went wrong, and how to look at it."""
    from eitbench.report.failures import debug_command, failures
    found = failures(store, records)
    for failure in found:
        options.say(failure, err=True)
    hints = filter(None, (debug_command(failure, asked) for failure in found))
    if (hint := next(hints, "")) and "--isolate none" not in typed().replace("=", " "):
        options.say(f"to debug it in this process, where breakpoint() stops:\n  {hint}", err=True)


def _end_if_lost(asked: Sequence[Job], store: EpisodeStore,
                 before: Sequence[dict[str, Any]] = ()) -> None:
    """Exit status 1 if there is a method that finished none of the episodes it was asked for."""
    from eitbench.bench.run import successful
    done = {job.method for job in successful(asked, [*before, *store.results()])}
    lost = dict.fromkeys(job.load().name for job in asked if job.method not in done)
    if lost:
        options.say(f"no episode was finished by {', '.join(lost)}", err=True)
        raise typer.Exit(1)
