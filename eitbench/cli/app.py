"""The command line of eitbench."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated

import typer

from eitbench import __version__
from eitbench.cli import learn, options
from eitbench.cli.estimate import estimate
from eitbench.cli.run import command_line, print_report, run
from eitbench.cli.verify import verify

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
                  context_settings={"help_option_names": ["-h", "--help"]}, help="""
Benchmark estimators that see a flow only through voltages on the pipe's wall.

A first look:  eitbench run  — runs our baselines on four test episodes, prints the table, \
writes results/index.html.
""")


def _say_version(asked: bool) -> None:
    if asked:
        options.echo(f"eitbench {__version__}")
        raise typer.Exit


@app.callback()
def _main(
    version: Annotated[bool, typer.Option(
        "--version", callback=_say_version, is_eager=True, help="Say which this is.")] = False,
) -> None:
    pass


@app.command("list")
def list_() -> None:
    """Show the environments, the baselines and policies, and which boards they play on."""
    from eitbench.bench.methods import builtin_methods, load_method
    from eitbench.bench.tracks import ids, measured_ids, subtracks_of
    from eitbench.worlds.registry import GROUPS, entry
    from eitbench.worlds.task import lag_steps
    lines = []
    for group in GROUPS:
        names = [name for name in ids() if entry(name).group == group]
        lines += [(f"environments: {group}", "", "")] * bool(names)
        for name in names:
            each = entry(name)
            schedule = each.world.schedule
            about = (f"lag {lag_steps(each.world, each.settings.get('lag', 0))}, "
                     f"{schedule.scored_steps} scored of {each.world.n_steps} states")
            if schedule.budget is not None:
                about += f", {schedule.budget} injections allowed"
            if each.nominal:
                about += f", variant {each.variant} of {each.nominal}"
            about += ", starting point" * each.is_starting_point
            lines.append((f"  {name}", subtracks_of(name, {})[0], about))
    lines.append(("environments: measured data", "", ""))
    lines += [(f"  {name}", "measured", "data are downloaded separately")
              for name in measured_ids()]
    for track, heading in (("estimation", "baselines"), ("injection", "policies")):
        lines.append((heading, "", ""))
        methods = {name: load_method(name, track) for name in builtin_methods(track)}
        lines += [(f"  {name}", ", ".join(method.subtracks), method.title)
                  for name, method in methods.items()]
    for name, boards, about in lines:
        options.echo(f"{name:42} {boards:30}  {about}".rstrip())


app.command()(run)


@app.command()
def submit(
    env: options.Environments = None,
    baseline: Annotated[str | None, typer.Option(
        help="Name of one of ours, or the path of your own .py file.")] = None,
    policy: Annotated[str | None, typer.Option(
        help="The same of an injection policy, or the path of a trained agent's model.zip. Without "
             "any method: all of ours, by default in all environments.")] = None,
    seeds: Annotated[str | None, typer.Option(
        help="Test episodes, as in test:0-9. Default: those of the boards.")] = None,
    official: Annotated[bool, typer.Option(
        "--official", help="For maintainers: a run of theirs.")] = False,
    isolate: options.Isolate = options.Isolation.auto,
    jobs: options.Jobs = options.CORES,
    backend: options.Backends = options.Backend.loky,
    out: options.Out = Path("results"),
    to: Annotated[Path, typer.Option(help="Folder of the records.")] = options.RECORDS,
) -> None:
    """Play the test episodes with one baseline or policy, or all of ours, and write records for the
    leaderboards.

    Episodes are stored in OUT the moment they are done; the same command again resumes.
    """
    from eitbench.bench.records import read_record
    from eitbench.bench.store import EpisodeStore
    from eitbench.bench.submit import submit
    with options.cli_errors():
        if baseline and policy:
            raise ValueError("one of --baseline and --policy may be given, got both")
        seeds_asked = options.parse_episodes(seeds)
        for path in submit(baseline or policy, env or [], seeds_asked, EpisodeStore(out), to,
                           policy=policy is not None, official=official, isolate=isolate,
                           n_jobs=jobs, backend=backend, command=command_line()):
            episodes = read_record(path)["episodes"]
            failed = sum(episode["status"] != "ok" for episode in episodes)
            options.echo(f"wrote {path}: {len(episodes)} episodes"
                        + (f", {failed} failed" if failed else ""))


app.command()(verify)


@app.command()
def golden(
    names: Annotated[list[str] | None, typer.Argument(
        help="Environment ids or built-in methods. Default: all.")] = None,
    new_version: Annotated[bool, typer.Option(
        "--new-version", help="Write moved numbers as the method's next version.")] = False,
) -> None:
    """Compare worlds and built-in methods with their golden files (for maintainers).

    Exit status 0 if all numbers agree, 1 otherwise. Missing files are written. A world whose
    numbers have moved needs a new id, the next -vN. All files take about half an hour.
    """
    from eitbench.bench import golden
    any_moved = False
    with options.cli_errors():
        for name, status, differences in golden.update(names or [], new_version=new_version):
            any_moved |= status == "moved"
            options.echo(f"{name}: {status}")
            for difference in differences:
                options.echo(f"  {difference}", err=status == "moved")
    if any_moved:
        options.echo("numbers have moved: find the cause; or give the world the next -vN, or write "
                    "the method's next version with --new-version and run its records again",
                    err=True)
        raise typer.Exit(1)


app.add_typer(learn.fit, name="fit")
for _command in (learn.bank, learn.train, learn.export, estimate):
    app.command()(_command)


@app.command()
def leaderboard(
    out: options.Out = Path("results"),
    records: Annotated[Path | None, typer.Option(
        help="Folder of the leaderboards' records, such as leaderboards/results: render "
             "leaderboard.csv, leaderboard.md, episodes.csv.gz and the pages site/ beside it "
             "instead.")] = None,
) -> None:
    """Print the table and write the page again from the results stored in a folder.

    Of --records, those that are not valid are left out and named: exit status 1. Without any that
    is valid nothing is written.
    """
    if records is None:
        with options.cli_errors():
            return print_report(out)
    from eitbench._files import write_atomically
    from eitbench.bench.episode_table import table_path, write_episode_table
    from eitbench.bench.records import read_valid_files
    from eitbench.report.boards import read_leaderboard_records
    from eitbench.report.site import collect, render, render_site, write_site
    with options.cli_errors():
        found, complaints = read_leaderboard_records(records)
        out = records.parent
        site = collect(found, out)
        complaints += site.measured.errors
        texts = render(site)
        write_site(out / "site", render_site(site))
    for name, text in texts.items():
        write_atomically(out / name, text.encode())
        options.echo(f"wrote {out / name}")
    options.echo(f"wrote {out / 'site' / 'index.html'}")
    write_episode_table(read_valid_files(records)[0].values(), table_path(records))
    options.echo(f"wrote {table_path(records)}")
    for complaint in complaints:
        options.echo(f"left out: {complaint}", err=True)
    raise typer.Exit(bool(complaints))


@app.command()
def compare(
    a: Annotated[str, typer.Argument(
        help="A record's file, or METHOD or METHOD@VERSION among the records.")],
    b: Annotated[str, typer.Argument(help="The same of the other.")],
    records: options.Records = options.RECORDS,
    env: options.Environments = None,
    score: Annotated[str, typer.Option(help="By which score.")] = "error",
) -> None:
    """Compare two methods seed by seed: differences with intervals, and how often the first is
    better; over several environments by gains, as on the boards."""
    from eitbench.report import compare as comparison
    with options.cli_errors():
        ours, theirs = ([record for record in comparison.find_records(name, records)
                         if not env or record["environment"]["id"] in env] for name in (a, b))
        table = comparison.compare(ours, theirs, score, comparison.naive_baseline_records(records))
    names = comparison.display_names(ours[0], theirs[0])
    width = shutil.get_terminal_size().columns
    options.echo(comparison.format_comparison(table, *names, score, width))


@app.command()
def render(
    env: options.EnvironmentId = "eitbench/Pipe2D-v0",
    baseline: Annotated[list[str] | None, typer.Option(
        help="Name of one of ours, or a .py file; repeatable. Default: kalman_filter.")] = None,
    policy: Annotated[str | None, typer.Option(
        help="The same of an injection policy, or of an agent's model.zip, in place of a baseline "
             "where injections are asked for.")] = None,
    seed: Annotated[str, typer.Option(help="The episode, such as dev:0.")] = "dev:0",
    step: Annotated[int | None, typer.Option(help="Only this state t, as a PNG.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Draw one state in so many.")] = 1,
    out: Annotated[Path, typer.Option(
        "--out", "-o", help="An animation .gif or .webp, or a .png with --step.",
    )] = Path("results/episode.gif"),
    isolate: options.Isolate = options.Isolation.auto,
) -> None:
    """Draw an episode: truth, estimate, its spread, electrodes; of several baselines estimates."""
    from eitbench.bench.tracks import track_of
    from eitbench.report.animate import animate
    with options.cli_errors():
        if track_of(env) == "injection" and policy is None:
            raise ValueError(f"policy must be given for {env}, which asks for injections")
        animate(env, [policy] if policy else baseline or ["kalman_filter"], seed, step, out,
                every=every, isolate=isolate)
        options.echo(f"wrote {out}")


REPLACED = {
    "cards": "eitbench golden", "check": "eitbench verify RECORDS…",
    "fit-model": "eitbench fit model", "fit-prior": "eitbench fit prior",
    "policies": "eitbench run --env ID --policy NAME", "reproduce": "python studies/thesis NAME",
    "season": "eitbench verify --top 3 --held-out 20 --secret FILE",
    "submit-measured": "eitbench submit --env eitbench/Measured-CASE-v0"}
"""Removed command -> what replaces it."""


def removed(context: typer.Context) -> None:
    """Print what replaces a removed command."""
    name = str(context.info_name)
    options.echo(f"`eitbench {name}` was removed: use `{REPLACED[name]}`", err=True)
    raise typer.Exit(2)


for _name in REPLACED:
    app.command(_name, hidden=True, add_help_option=False, context_settings={
        "allow_extra_args": True, "ignore_unknown_options": True})(removed)

if __name__ == "__main__":
    app()
