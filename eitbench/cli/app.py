"""The command line of eitbench."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from eitbench import __version__
from eitbench.cli import options
from eitbench.cli.estimate import estimate
from eitbench.cli.export import export
from eitbench.cli.fit import app as fit_commands
from eitbench.cli.maintain import golden
from eitbench.cli.run import report, run, typed
from eitbench.cli.verify import verify

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
                  context_settings={"help_option_names": ["-h", "--help"]}, help="""
Benchmark estimators that see a flow only through voltages on the pipe's wall.

A first look:  eitbench run  — runs our baselines on four test episodes, prints the table, \
writes results/index.html.
""")

Algorithm = StrEnum("Algorithm", ["ppo", "dqn", "sac", "recurrent_ppo", "maskable_ppo"])


def _say_version(asked: bool) -> None:
    if asked:
        options.say(f"eitbench {__version__}")
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
    from eitbench.bench.methods import load_method, own_methods
    from eitbench.bench.tracks import boards_of, ids, measured_ids
    from eitbench.data.regions import outline
    from eitbench.worlds.registry import entry
    from eitbench.worlds.task import lag_steps
    # Nothing is built: what takes long to make is shipped, the rest are numbers of the world.
    options.say("environments")
    for name in ids("estimation"):
        world = entry(name).world
        flow = world.velocity_model
        numbers = outline(world).mass.shape[0] + (0 if flow is None else flow.size)
        lag = lag_steps(world, entry(name).settings.get("lag", 0))
        options.say(f"  {name:40} {boards_of(name, {})[0]:10}  lag {lag}, "
                    f"{world.schedule.scored_steps} scored of {world.n_steps} states, "
                    f"{numbers} numbers each")
    for name in ids("injection"):
        world = entry(name).world
        L = world.vessel.n_electrodes
        limit = world.instrument.limit
        budget = world.schedule.budget
        what = f"{limit} currents" if limit else f"{L * (L - 1) // 2} electrode pairs"
        allowed = "" if budget is None else f", {budget} of them allowed"
        options.say(f"  {name:40} injection   {what}, {world.n_steps - len(world.currents)} "
                    f"injections{allowed}")
    for name in measured_ids():
        options.say(f"  {name:40} measured    data are downloaded separately")
    for track, heading in (("estimation", "baselines"), ("injection", "policies")):
        options.say(heading)
        for name in own_methods(track):
            method = load_method(name, track)
            options.say(f"  {name:40} {', '.join(method.boards):30}  {method.title}")


app.command()(run)


@app.command()
def bank(
    env: Annotated[str, typer.Option(help="Environment id.")] = "eitbench/Pipe2D-v0",
    seeds: Annotated[str, typer.Option(help="Episodes, such as train:0-999.")] = "train:0-99",
    jobs: options.Jobs = options.CORES,
    backend: options.Backends = options.Backend.loky,
) -> None:
    """Simulate many episodes ahead of training and keep what an environment needs of them.

    They lie, memory-mapped, in the cache folder ($EITBENCH_CACHE). The same command again resumes.
    """
    import shutil

    from eitbench.data.bank import fill, missing_seeds, recording_bytes
    from eitbench.data.cache import folder
    from eitbench.data.seeds import parse_seeds
    from eitbench.worlds.registry import entry
    with options.clear_errors():
        numbers = parse_seeds(seeds)
        world = entry(env).world
    place = folder(world)
    each = recording_bytes(world)
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise typer.BadParameter(f"recordings cannot be kept in {place}: {error}") from error
    missing = len(missing_seeds(world, numbers))
    options.say(f"{len(numbers)} episodes, {len(numbers) * each / 1e6:.0f} MB in {place}; "
                f"{missing} to simulate")
    free = shutil.disk_usage(place).free
    if missing * each > free:
        raise typer.BadParameter(f"seeds need {missing * each / 1e9:.1f} GB more, and "
                                 f"{free / 1e9:.1f} GB are free")
    with options.clear_errors():
        made = fill(world, numbers, n_jobs=jobs, backend=backend)
    options.say(f"{made} simulated, {len(numbers) - made} were there")


@app.command()
def train(
    env: options.InjectionId,
    algo: Annotated[Algorithm, typer.Option(
        help="Algorithm of stable-baselines3 or sb3-contrib.")] = Algorithm.ppo,
    config: Annotated[Path, typer.Option(
        help="A YAML file such as those in baselines/rl.")] = Path("baselines/rl/ppo.yml"),
    seed: Annotated[int, typer.Option(
        min=0, help="Of the training; episodes are drawn from the train split.")] = 0,
    steps: Annotated[int | None, typer.Option(
        min=0, help="Steps in place of the configuration's total_steps.")] = None,
    out: Annotated[Path | None, typer.Option(
        "--out", "-o", help="Folder of the run. Default: results/training/ENV/ALGO/seedK.")] = None,
) -> None:
    """Train an agent to choose injections.

    The same command again goes on from the last checkpoint. The folder receives model.zip,
    config.json, monitor.csv, evaluations.npz (scores on dev episodes) and logs for TensorBoard.
    """
    from dataclasses import replace
    with options.clear_errors():
        from eitbench.rl import training
        asked = training.read_config(config)
        if steps is not None:
            asked = replace(asked, total_steps=steps)
        folder = out or Path("results/training") / env.replace("/", "-") / algo / f"seed{seed}"
        model = training.train(env, algo.value, asked, seed, folder)
    options.say(f"wrote {model}")


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
    with options.clear_errors():
        if baseline and policy:
            raise ValueError("one of --baseline and --policy may be given, got both")
        seeds_asked = options.numbers(seeds)
        for path in submit(baseline or policy, env or [], seeds_asked, EpisodeStore(out), to,
                           policy=policy is not None, official=official, isolate=isolate,
                           n_jobs=jobs, backend=backend, command=typed()):
            episodes = read_record(path)["episodes"]
            failed = sum(episode["status"] != "ok" for episode in episodes)
            options.say(f"wrote {path}: {len(episodes)} episodes"
                        + (f", {failed} failed" if failed else ""))


app.command()(verify)
app.command()(golden)
app.add_typer(fit_commands, name="fit")
app.command()(estimate)
app.command()(export)


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
        with options.clear_errors():
            return report(out)
    from eitbench._files import write_atomically
    from eitbench.bench.records import write_episode_table_of
    from eitbench.report.boards import read_for_boards
    from eitbench.report.site import Beside, Measured, collect, render, render_site, write_site
    with options.clear_errors():
        found, complaints = read_for_boards(records)
        measured = Measured.of(records.parent)
        complaints += measured.complaints
        site = collect(found)
        out = records.parent
        pages = render_site(site, Beside.of(records.parent, out / "site"), measured)
        texts = render(site, measured)
        write_site(out / "site", pages)
    for name, text in texts.items():
        write_atomically(out / name, text.encode())
        options.say(f"wrote {out / name}")
    options.say(f"wrote {out / 'site' / 'index.html'}")
    options.say(f"wrote {write_episode_table_of(records)}")
    for complaint in complaints:
        options.say(f"left out: {complaint}", err=True)
    raise typer.Exit(bool(complaints))


@app.command()
def compare(
    a: Annotated[str, typer.Argument(
        help="A record's file, or METHOD or METHOD@VERSION among the records.")],
    b: Annotated[str, typer.Argument(help="The same of the other.")],
    records: options.Records = options.RECORDS,
    score: Annotated[str, typer.Option(help="By which score.")] = "error",
    html: Annotated[Path | None, typer.Option(help="Write a page too.")] = None,
) -> None:
    """Compare two methods seed by seed: differences with intervals, and how often the first is
    better; over several environments by gains, as on the boards."""
    from eitbench._files import write_atomically
    from eitbench.report import compare as comparison
    from eitbench.report.terminal import width
    with options.clear_errors():
        ours, theirs = (comparison.find(name, records) for name in (a, b))
        table = comparison.compare(ours, theirs, score, comparison.floors(records))
    names = comparison.names(ours[0], theirs[0])
    options.say(comparison.in_terminal(table, *names, score, width()))
    if html is not None:
        write_atomically(html, comparison.html(table, *names, score).encode())
        options.say(f"\nwrote {html}")


@app.command()
def render(
    env: Annotated[str, typer.Option(help="Environment id.")] = "eitbench/Pipe2D-v0",
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
    with options.clear_errors():
        if track_of(env) == "injection" and policy is None:
            raise ValueError(f"policy must be given for {env}, which asks for injections")
        animate(env, [policy] if policy else baseline or ["kalman_filter"], seed, step, out,
                every=every, isolate=isolate)
        options.say(f"wrote {out}")


REPLACED = {
    "cards": "`eitbench golden`",
    "submit-measured": "`eitbench submit --env eitbench/Measured-CASE-v0`",
    "kits": "`eitbench.bench.package_data.write_package_data()`, for maintainers",
    "fit-model": "`eitbench fit model`",
    "fit-prior": "`eitbench fit prior`",
    "policies": "`eitbench run --env ID --policy NAME` runs injection policies",
    "reproduce": "`python studies/thesis NAME` in a checkout draws a figure of the thesis",
    "check": "`eitbench verify RECORDS…` verifies the records of a submission",
    "held-out": "docs/trust.md says how to draw the secret of held-out episodes",
    "season": "`eitbench verify --top 3 --held-out 20 --secret FILE` verifies the first records; "
              "there is one public test split",
}
"""Removed command -> what replaces it."""


def _removed(name: str) -> None:
    @app.command(name, hidden=True, add_help_option=False, context_settings={
        "allow_extra_args": True, "ignore_unknown_options": True})
    def removed() -> None:
        options.say(f"`eitbench {name}` was removed: {REPLACED[name]}", err=True)
        raise typer.Exit(2)


for _name in REPLACED:
    _removed(_name)

if __name__ == "__main__":
    app()
