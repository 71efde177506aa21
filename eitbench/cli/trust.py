"""The commands `verify` and `check`: whether records are true."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from eitbench.cli import options


def verify(
    record: Annotated[Path | None, typer.Argument(
        help="A record's file.", callback=options.found)] = None,
    baseline: Annotated[str | None, typer.Option(
        help="The method's file, if it is not one of ours.")] = None,
    policy: Annotated[str | None, typer.Option(help="The same of an injection policy.")] = None,
    episodes: Annotated[int, typer.Option(min=0, help="How many are played again.")] = 3,
    seed: Annotated[int | None, typer.Option(
        min=0, help="By which they are drawn. Default: any; with --all 0.")] = None,
    tolerance: Annotated[float, typer.Option(
        min=0.0, help="Relative difference of scores that is none.")] = 1e-6,
    isolate: options.Isolate = options.Isolation.always,
    held_out: Annotated[int, typer.Option(
        "--held-out", min=0, help="For maintainers: play so many held-out episodes too, and "
                                  "ask whether the record is too good.")] = 0,
    salt_file: Annotated[Path | None, typer.Option(
        help="From which they follow; see `eitbench held-out`.")] = None,
    every: Annotated[bool, typer.Option(
        "--all", help="Every official record of a folder; resumes.")] = False,
    records: options.Records = options.RECORDS,
    env: Annotated[list[str] | None, typer.Option(
        help="With --all: only this environment; may be repeated.")] = None,
    jobs: options.Jobs = options.CORES,
    backend: options.Backends = options.Backend.loky,
    out: Annotated[Path, typer.Option(
        "--out", "-o", help="With --all: where what came out is kept.")] = Path("results/verify"),
) -> None:
    """Play episodes of a record again and say whether it is true: exit status 0 if so, 1 if not.

    They are simulated anew, whatever the cache folder holds. Numbers decide: of our own methods it
    does not matter which text of the library played; the file of somebody else's must be the very
    one that the record names.

    With --all, episodes of every official record of a folder, cheap environments first; the same
    command again goes on where it was interrupted.
    """
    if every:
        if record or baseline or policy or held_out or salt_file:
            raise typer.BadParameter("--all takes neither a record's file nor --baseline, "
                                     "--policy, --held-out or --salt-file")
        return _verify_all(records, env or [], out, tolerance, episodes=episodes, seed=seed or 0,
                           isolate=isolate, n_jobs=jobs, backend=backend)
    if record is None:
        raise typer.BadParameter("a record's file must be given, or --all")
    import secrets

    from eitbench.bench import held_out as beyond
    from eitbench.bench import verify as again
    from eitbench.bench.records import read_record
    from eitbench.bench.salts import hash_of, read_published_salt
    with options.clear_errors():
        if baseline and policy:
            raise ValueError("only one of --baseline and --policy may be given")
        if (held_out > 0) != (salt_file is not None):
            raise ValueError("--held-out and --salt-file belong together")
        if not episodes and not held_out:
            raise ValueError("--episodes must be at least 1 where no --held-out episodes are "
                             "played, got 0")
        salt = read_published_salt(salt_file) if salt_file else b""
    seed = secrets.randbelow(2**32) if seed is None else seed
    differences = list[str]()
    try:
        with again.empty_cache():
            claimed = read_record(record)
            job = again.job_of(claimed, baseline or policy, isolate)
            # what cannot be judged is said before anything is played
            beyond_it = beyond.plays(claimed, job, salt, held_out) if held_out else None
            if remark := again.outdated(claimed, job):
                options.say(f"{remark}\n")
            if episodes:
                table, differences = again.verify(claimed, job, episodes=episodes, seed=seed,
                                                  tolerance=tolerance)
                options.say(f"episodes drawn with --seed {seed}, isolation {job.isolation}\n\n"
                            f"{table}\n")
            if beyond_it:
                table, more = beyond.held_out(claimed, beyond_it)
                differences += more
                options.say("held-out episodes of the salt with sha256 "
                            f"{hash_of(salt)}\n\n{table}\n")
    except ValueError as error:
        differences.append(str(error))
    options.say_differences(differences)
    options.say(f"{record.name}: what was played again is as it says")


def _verify_all(folder: Path, environments: list[str], out: Path, tolerance: float,
                **how: Any) -> None:
    from eitbench.bench.replay import by_environment, differing, official_records, verify_all
    with options.clear_errors():
        rows = verify_all(official_records(folder, environments), out, **how)
    options.say(by_environment(rows, tolerance))
    options.say_differences(differing(rows, tolerance))


def check(
    submitted: Annotated[Path, typer.Argument(
        help="The submission's folder leaderboards.")],
    against: Annotated[Path, typer.Option(
        help="The folder into which it is to be merged.",
        callback=options.found)] = Path("leaderboards"),
    episodes: Annotated[int, typer.Option(
        min=1, help="How many of each new record are played again.")] = 1,
    seed: Annotated[int | None, typer.Option(
        min=0, help="By which they are drawn. Default: any.")] = None,
    held_out: Annotated[int, typer.Option(
        "--held-out", min=0, help="Play so many held-out episodes of each method too.")] = 0,
    salt_file: Annotated[Path | None, typer.Option(
        help="From which they follow; see `eitbench held-out`.")] = None,
    official: Annotated[bool, typer.Option(
        "--official", help="Records may call themselves official.")] = False,
    out: Annotated[Path | None, typer.Option(
        "--out", "-o", help="Write the report, Markdown, here too.")] = None,
) -> None:
    """For maintainers: check all that a pull request adds or changes in leaderboards/, as their CI
    does. Exit status 0 if nothing speaks against it, 1 if something does.

    Run it in a checkout of your own: the submission is only read, and its methods play in
    processes of their own.
    """
    import secrets

    from eitbench._files import write_atomically
    from eitbench.bench.salts import read_published_salt
    from eitbench.report import submission
    with options.clear_errors():
        if (held_out > 0) != (salt_file is not None):
            raise ValueError("--held-out and --salt-file belong together")
        salt = read_published_salt(salt_file) if salt_file else b""
        drawn = secrets.randbelow(2**32) if seed is None else seed
        asked = submission.Asked(episodes, drawn, held_out, salt, official)
        findings = list(submission.check(submitted, against, asked))
    report = submission.markdown(findings)
    options.say(f"{report}\nepisodes drawn with --seed {drawn}")
    if out is not None:
        write_atomically(out, report.encode())
    if any(finding.problems for finding in findings):
        raise typer.Exit(1)
