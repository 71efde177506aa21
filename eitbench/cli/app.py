"""Command line of eitbench."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from eitbench import __version__
from eitbench.cli import learn, options
from eitbench.cli.estimate import estimate, fetch
from eitbench.cli.run import command_line, print_report, run
from eitbench.cli.verify import verify

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
                  context_settings={"help_option_names": ["-h", "--help"]}, help="""
Benchmark of state estimation in electrical impedance tomography.

Quick start:  eitbench run  — runs the built-in estimators on four test episodes, prints the \
table, writes results/index.html.
""")

command = partial(app.command, cls=options.Command)


def _print_version(asked: bool) -> None:
    if asked:
        options.echo(f"eitbench {__version__}")
        raise typer.Exit


@app.callback()
def _main(
    version: Annotated[bool, typer.Option(
        "--version", callback=_print_version, is_eager=True, help="Print the version.")] = False,
) -> None:
    pass


@command("list")
def list_() -> None:
    """List environments, built-in estimators and policies, with their subtracks."""
    from eitbench.bench.methods import builtin_methods, builtin_summary
    from eitbench.bench.tracks import ids, measured_ids, subtrack_of_id
    from eitbench.worlds.registry import GROUPS, entry, published_returns
    from eitbench.worlds.task import lag_steps
    lines = []
    for group in GROUPS:
        found = [each for each in map(entry, ids()) if each.group == group]
        lines += [(f"environments: {group}", "", "")] * bool(found)
        for each in found:
            schedule = each.world.schedule
            about = (f"lag {lag_steps(each.world, each.settings.get('lag', 0))}, "
                     f"{schedule.scored_steps} scored of {each.world.n_steps} states")
            if schedule.budget is not None:
                about += f", at most {schedule.budget} injections"
            if each.nominal:
                about += f", shifted environment, variant {each.variant} of {each.nominal}"
            if returns := published_returns(each.id):
                about += ", returns " + ", ".join(f"{row['group']} {float(row['mean']):.3g}"
                                                  for row in returns)
            about += ", recommended to new users" * each.is_starting_point
            lines.append((f"  {each.id}", subtrack_of_id(each.id), about))
    lines.append(("environments: measured data", "", ""))
    lines += [(f"  {name}", "measured", "measurements are downloaded separately")
              for name in measured_ids()]
    for track, heading in (("estimation", "estimators"), ("injection", "policies")):
        lines.append((heading, "", ""))
        lines += [(f"  {name}", ", ".join(subtracks), title) for name in builtin_methods(track)
                  for title, subtracks in [builtin_summary(name, track)]]
    for name, boards, about in lines:
        options.echo(f"{name:42} {boards:30}  {about}".rstrip())


command()(run)


@command()
def submit(
    env: options.Environments = None,
    baseline: Annotated[str | None, typer.Option(
        help="Built-in estimator name, or path of a .py file.")] = None,
    policy: options.Policy = None,
    seeds: Annotated[str | None, typer.Option(
        help="Episode seeds, e.g. test:0-9. Default: all seeds of the leaderboards.")] = None,
    official: Annotated[bool, typer.Option(
        "--official", help="Mark the record as official (maintainers only).")] = False,
    isolate: options.Isolate = options.Isolation.auto,
    jobs: options.Jobs = options.CORES,
    backend: options.Backends = options.Backend.loky,
    out: options.Out = Path("results"),
    to: Annotated[Path, typer.Option(help="Folder of the records.")] = options.RECORDS,
) -> None:
    """Run the test episodes with one estimator or policy, by default with all built-in ones, and
    write records for the leaderboards.

    Each episode is stored in OUT when it finishes; the same command resumes an interrupted run.
    """
    from eitbench.bench.records import read_record
    from eitbench.bench.store import EpisodeStore
    from eitbench.bench.submit import submit
    from eitbench.bench.text import describe_scores, scores_by_seed
    from eitbench.data.seeds import seed_ranges
    if baseline and policy:
        raise ValueError("one of --baseline and --policy may be given, got both")
    seeds_asked = options.parse_episodes(seeds)
    for path in submit(baseline or policy, env or [], seeds_asked, EpisodeStore(out), to,
                       policy=policy is not None, official=official, isolate=isolate,
                       n_jobs=jobs, backend=backend, command=command_line()):
        record = read_record(path)
        options.echo(f"wrote {path}: {describe_scores(record)}")
        contrasts = scores_by_seed(record, "contrast_error")
        if worse := [seed for seed, contrast in contrasts.items() if contrast > 1.0]:
            options.echo("warning: ẽ_c is larger than for the homogeneous estimate in "
                         f"{seed_ranges(worse)}; the method may have diverged", err=True)


command()(verify)


@command()
def golden(
    names: Annotated[list[str] | None, typer.Argument(
        help="Environment ids or built-in methods. Default: all.")] = None,
    new_version: Annotated[bool, typer.Option(
        "--new-version", help="Write changed numbers as the method's next version.")] = False,
) -> None:
    """Compare worlds and built-in methods with their golden files (for maintainers).

    Exit status 0 if all numbers agree, 1 otherwise. Missing files are written. A world whose
    numbers have changed needs a new id, the next -vN. All files take about half an hour.
    """
    from eitbench.bench import golden
    any_moved = False
    for name, status, differences in golden.update(names or [], new_version=new_version):
        any_moved |= status == "moved"
        options.echo(f"{name}: {status}")
        for difference in differences:
            options.echo(f"  {difference}", err=status == "moved")
    if any_moved:
        options.echo("numbers have changed: find the cause; or give the world the next -vN, or "
                    "write the method's next version with --new-version and rerun its records",
                    err=True)
        raise typer.Exit(1)


app.add_typer(learn.fit, name="fit")
for _command in (learn.bank, learn.train, learn.export, estimate, fetch):
    command()(_command)


@command()
def leaderboard(
    out: options.Out = Path("results"),
    records: Annotated[Path | None, typer.Option(
        help="Folder of the leaderboards' records: render leaderboard.csv, leaderboard.md, "
             "episodes.csv.xz and the pages site/ next to it instead.")] = None,
    env: options.Environments = None,
) -> None:
    """Print the table and rewrite the HTML report from the results stored in a folder.

    With --records, invalid records are reported, with exit status 1; without a valid one no file is
    written. --env imports the module of a user-defined environment.
    """
    if records is None:
        return print_report(out)
    from eitbench._files import write_atomically
    from eitbench.bench.episode_table import table_path, write_episode_table
    from eitbench.report.boards import read_leaderboard_records
    from eitbench.report.site import collect, render, render_site, write_site
    found, complaints = read_leaderboard_records(records)
    out = records.parent
    site = collect([record for record in found if record["split"] == "test"], out)
    complaints += site.measured.errors
    texts = render(site)
    write_site(out / "site", render_site(site))
    for name, text in texts.items():
        write_atomically(out / name, text.encode())
        options.echo(f"wrote {out / name}")
    options.echo(f"wrote {out / 'site' / 'index.html'}")
    write_episode_table(found, table_path(records))
    options.echo(f"wrote {table_path(records)}")
    for complaint in complaints:
        options.echo(f"left out: {complaint}", err=True)
    raise typer.Exit(bool(complaints))


@command()
def compare(
    a: Annotated[str, typer.Argument(
        help="File of a record, or METHOD or METHOD@VERSION among the records; the name of an "
             "agent without its training seed means the mean over its trainings.")],
    b: Annotated[str, typer.Argument(help="The method to compare with, as for A.")],
    records: options.Records = options.RECORDS,
    env: options.Environments = None,
    score: Annotated[str, typer.Option(help="Score to compare.")] = "error",
) -> None:
    """Compare two methods seed by seed: differences with intervals, and the fraction of episodes in
    which A is better. The errors of several environments are aggregated as skill scores,
    without shifted environments."""
    from eitbench.report import compare as comparison
    ours, theirs = ([record for record in comparison.find_records(name, records)
                     if not env or record["environment"]["id"] in env] for name in (a, b))
    table = comparison.compare(ours, theirs, score, comparison.naive_baseline_records(records))
    width = options.table_width()
    options.echo(comparison.format_comparison(table, ours[0], theirs[0], score, width))


@command()
def render(
    env: options.EnvironmentId = "eitbench/Pipe2D-v0",
    baseline: Annotated[list[str] | None, typer.Option(
        help="Estimator name or path; may be repeated. Default: kalman_filter.")] = None,
    policy: options.Policy = None,
    seed: Annotated[str, typer.Option(help="Episode seed, e.g. dev:0.")] = "dev:0",
    step: Annotated[int | None, typer.Option(help="Only this state t, as a PNG.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Draw every Nth state.")] = 1,
    out: Annotated[Path, typer.Option(
        "--out", "-o", help="An animation .gif or .webp, or a .png with --step.",
    )] = Path("results/episode.gif"),
    isolate: options.Isolate = options.Isolation.auto,
) -> None:
    """Draw an episode: ground truth, estimates, electrodes, standard deviation of one estimate."""
    from eitbench.bench.tracks import track_of
    from eitbench.report.animate import animate
    if track_of(env) == "injection" and policy is None:
        raise ValueError(f"policy must be given for {env}, an injection environment")
    animate(env, [policy] if policy else baseline or ["kalman_filter"], seed, step, out,
            every=every, isolate=isolate)
    options.echo(f"wrote {out}")


REPLACED = {
    "cards": "eitbench golden", "check": "eitbench verify RECORDS…",
    "fit-model": "eitbench fit model", "fit-prior": "eitbench fit prior",
    "policies": "eitbench run --env ID --policy NAME", "reproduce": "python studies/thesis NAME",
    "season": "eitbench verify --top 3 --held-out 20 --secret FILE",
    "submit-measured": "eitbench submit --env eitbench/Measured-CASE-v0"}
"""Removed command -> replacement."""


def report_removed(context: typer.Context) -> None:
    """Print the replacement of a removed command."""
    name = str(context.info_name)
    options.echo(f"`eitbench {name}` was removed: use `{REPLACED[name]}`", err=True)
    raise typer.Exit(2)


for _name in REPLACED:
    app.command(_name, hidden=True, add_help_option=False, context_settings={
        "allow_extra_args": True, "ignore_unknown_options": True})(report_removed)
