"""The commands `season …`: test episodes that change, and whether a season's best are true."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from eitbench.cli import options

app = typer.Typer(help="Which test episodes are scored now; for maintainers, to begin the next "
                       "season, and to verify the best of this one.")
SaltFile = Annotated[Path, typer.Option(help="File of the salt.")]


@app.callback(invoke_without_command=True)
def season(context: typer.Context) -> None:
    """Say which season is on, and which is announced."""
    if context.invoked_subcommand:
        return
    from eitbench.data.seasons import EPISODES, current_season, seasons
    with options.clear_errors():
        known, now = seasons(), current_season()
    since = f"since {now.begun}, {EPISODES} episodes" if now.begun else "since the beginning"
    options.say(f"season {now.number}: test episodes {now.split}:0, {now.split}:1, … {since}")
    if not known[-1].has_begun:
        options.say(f"season {known[-1].number} is announced: its episodes {known[-1].split}:0, … "
                    f"will follow from the salt with sha256 {known[-1].salt_sha256}")


@app.command()
def announce(
    new: Annotated[Path, typer.Option(
        help="Where to write a new salt; keep it secret until the season begins, and keep it.")],
) -> None:
    """For maintainers: draw the salt of the next season's test episodes, and publish its hash in
    leaderboards/seasons.json."""
    from eitbench.bench.salts import announce_season
    from eitbench.data.seasons import PUBLISHED
    with options.clear_errors():
        announced = announce_season(new)
    options.say(f"wrote {new}, and announced season {announced.number} in {PUBLISHED}: sha256 "
                f"{announced.salt_sha256}")


@app.command()
def begin(salt_file: SaltFile) -> None:
    """For maintainers: publish the salt of the season that was announced. From now on its test
    episodes are played by default, and submitted, and the boards show them alone."""
    from eitbench.bench.salts import begin_season
    from eitbench.data.seasons import PUBLISHED
    with options.clear_errors():
        begun = begin_season(salt_file)
    options.say(f"wrote {PUBLISHED}: season {begun.number} has begun, with test episodes "
                f"{begun.split}:0, …; `eitbench submit --official` plays them")


@app.command()
def verify(
    salt_file: Annotated[Path, typer.Option(
        help="Of the held-out episodes; see `eitbench held-out`.")],
    top: Annotated[int, typer.Option(min=1, help="How many of each board.")] = 3,
    episodes: Annotated[int, typer.Option(min=2, help="Held-out episodes of each.")] = 20,
    env: options.Environments = None,
    records: options.Records = options.RECORDS,
    methods: Annotated[Path, typer.Option(
        help="Folder of the files of methods that are not ours.")] = options.METHODS,
    jobs: options.Jobs = options.CORES,
    backend: options.Backends = options.Backend.loky,
    out: Annotated[Path, typer.Option(
        "--out", "-o", help="Where what came out is kept, its owner's only.",
    )] = Path("results/season"),
) -> None:
    """For maintainers: let the best of each board play held-out episodes, and say whether their
    records are too good: exit status 0 if none is, 1 if one is or cannot be played.

    The same command again goes on where it was interrupted.
    """
    from eitbench.bench import podium
    from eitbench.bench.salts import hash_of, read_published_salt
    from eitbench.report.boards import boards, read_for_boards
    with options.clear_errors():
        salt = read_published_salt(salt_file)
        found, complaints = read_for_boards(records)
        asked = podium.best(found, boards(found), top, env or [])
    places = podium.places(asked, methods, salt, episodes)
    options.say(f"{len(places)} records, {episodes} held-out episodes each, some "
                f"{podium.seconds(places) / 3600:.1g} hours of one core")
    with options.clear_errors():
        verdicts = podium.judge(places, out, n_jobs=jobs, backend=backend)
    differences = list(complaints)
    for place, (table, wrong) in zip(places, verdicts, strict=True):
        record = place.record
        who = f"{record['environment']['name']}, {record['method']}@{record['version']}"
        options.say(f"\n{who}, rank {place.rank}: {'too good' if wrong else 'as it says'}\n{table}")
        differences += [f"{who}: {sentence}" for sentence in wrong]
    options.say(f"\nheld-out episodes of the salt with sha256 {hash_of(salt)}")
    options.say_differences(differences)
