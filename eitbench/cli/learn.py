"""Commands `bank`, `export`, `fit prior`, `fit model` and `train`: training episodes, and models
and agents fitted to them."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from eitbench.cli import options

Algorithm = StrEnum("Algorithm", ["ppo", "dqn", "sac", "recurrent_ppo", "maskable_ppo"])
Format = StrEnum("Format", ["npz", "hdf5", "minari"])
Link = StrEnum("Link", ["logarithm", "linear"])

fit = typer.Typer(no_args_is_help=True, help="Fit priors and models to training episodes.")


def bank(
    env: options.EnvironmentId = "eitbench/Pipe2D-v0",
    seeds: Annotated[str, typer.Option(help="Episode seeds, e.g. train:0-999.")] = "train:0-99",
    jobs: options.Jobs = options.CORES,
    backend: options.Backends = options.Backend.loky,
) -> None:
    """Simulate episodes before training, and store the arrays that an environment needs.

    They are memory-mapped files in the cache folder ($EITBENCH_CACHE). The same command resumes.
    """
    import shutil

    from eitbench.data.cache import folder
    from eitbench.data.presimulation import cached_episode_bytes, missing_seeds, presimulate
    from eitbench.data.seeds import parse_seeds
    from eitbench.worlds.registry import entry
    numbers = parse_seeds(seeds)
    world = entry(env).world
    place, size = folder(world), cached_episode_bytes(world)
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"episodes cannot be stored in {place}: {error}") from error
    missing = len(missing_seeds(world, numbers))
    options.echo(f"{len(numbers)} episodes, {len(numbers) * size / 1e6:.0f} MB in {place}; "
                 f"{missing} to simulate")
    free = shutil.disk_usage(place).free
    if missing * size > free:
        raise ValueError(f"seeds need {missing * size / 1e9:.1f} GB more, and "
                         f"{free / 1e9:.1f} GB are free")
    made = presimulate(world, numbers, n_jobs=jobs, backend=backend)
    options.echo(f"{made} simulated, {len(numbers) - made} were already stored")


def export(
    out: Annotated[str, typer.Option(
        "--out", "-o", help="Folder of the files; for minari the name of the data set, such as "
                            "eitbench/pipe2d/random-pair-v0.")],
    env: options.EnvironmentId = "eitbench/Pipe2D-v0",
    seeds: Annotated[str, typer.Option(help="Episode seeds, e.g. train:0-999.")] = "train:0-99",
    format: Annotated[Format, typer.Option(
        help="File format; hdf5 needs the extra export, minari the extra minari and --policy, "
             "which runs in this process.")] = Format.npz,
    policy: options.Policy = None,
    jobs: options.Jobs = options.CORES,
    backend: options.Backends = options.Backend.loky,
) -> None:
    """Export episodes for training: voltages, currents and ground truth, one file per episode, with
    a README that describes them and their score; or observations, actions and rewards of a policy
    as a Minari data set.

    Missing episodes are simulated. The same command resumes; a Minari data set is written at the
    end and cannot be resumed.
    """
    import eitbench
    if (policy is not None) != (format is Format.minari):
        raise ValueError("policy must be given with format minari, and with no other; got "
                         f"policy {policy} and format {format.value}")
    if policy is not None:
        from eitbench.bench.minari_export import export_minari
        written = export_minari(out, env, policy, seeds, n_jobs=jobs, backend=backend)
        options.echo(f"{written} episodes written; minari.load_dataset({out!r}) reads them")
    else:
        from eitbench.data.export import export as export_files
        examples = eitbench.dataset(env, seeds)
        written = export_files(examples, Path(out), format.value, n_jobs=jobs, backend=backend)
        options.echo(f"{written} episodes written to {out}, {len(examples) - written} were "
                    "already stored")


def train(
    env: options.EnvironmentId,
    algo: Annotated[Algorithm, typer.Option(
        help="Algorithm of stable-baselines3 or sb3-contrib.")] = Algorithm.ppo,
    config: Annotated[Path, typer.Option(
        help="YAML configuration, e.g. a file of baselines/rl.")] = Path("baselines/rl/ppo.yml"),
    seed: Annotated[int, typer.Option(
        min=0, help="Random seed of the training; episodes are from the train split.")] = 0,
    steps: Annotated[int | None, typer.Option(
        min=0, help="Number of steps instead of the configuration's total_steps.")] = None,
    out: Annotated[Path | None, typer.Option(
        "--out", "-o", help="Folder of the run. Default: results/training/ENV/ALGO/seedK.")] = None,
) -> None:
    """Train an agent to choose injections.

    The same command resumes from the last checkpoint. Missing episodes are simulated on one core;
    `eitbench bank` uses all cores. The folder receives model.zip, config.json, evaluations.npz
    (scores on dev episodes), K.monitor.csv (training episodes of the K-th start, with rewards times
    reward_scale) and logs for TensorBoard.
    """
    from dataclasses import replace

    import numpy as np

    from eitbench.rl import training
    asked = training.read_config(config)
    if steps is not None:
        asked = replace(asked, total_steps=steps)
    folder = out or Path("results/training") / env.replace("/", "-") / algo / f"seed{seed}"
    options.echo(f"{asked.total_steps} steps of {algo.value}, configured by {config}, with "
                 f"evaluations every {asked.interval} steps, in {folder}")
    model = training.train(env, algo.value, asked, seed, folder)
    last = {name: values[-1] for name, values in np.load(folder / "evaluations.npz").items()}
    options.echo(f"wrote {model}: ẽ_c {last['errors'].mean():.3g}, return "
                 f"{last['results'].mean():.3g} in {len(last['errors'])} dev episodes, with the "
                 f"reduced filter, after {last['timesteps']} steps")
    options.echo(f"next: eitbench run --env {env} --policy {model} --policy random_pair "
                 "--seeds dev:0-15")


@fit.command("prior", cls=options.Command)
def fit_prior(
    env: options.EnvironmentId,
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write, JSON.")],
    seeds: options.TrainSeeds = "train:0-199",
    link: Annotated[Link, typer.Option(
        help="Gaussian quantity: the inflow's logarithm, or the inflow.")] = Link.logarithm,
    nugget: Annotated[float, typer.Option(
        min=0.0, max=1.0, help="Fraction of the variance that is white in time.")] = 0.01,
    kept: Annotated[float, typer.Option(
        min=0.0, max=1.0, help="Inlet modes with less than this fraction of the variance are "
                               "omitted; each mode makes filters slower.")] = 1e-4,
    quiet: Annotated[float | None, typer.Option(
        help="Also fit the onset and end of slugs: a step is quiet if the Gaussian quantity is "
             "within ± this value at all nodes.")] = None,
) -> None:
    """Fit an inflow prior for filters (`eitbench.estimation.InflowPrior`) to the inflow of training
    episodes, without simulating their transport."""
    from eitbench.data.seeds import parse_seeds
    from eitbench.estimation import fit_prior_from_episodes
    from eitbench.worlds.registry import entry
    source: dict[str, Any] = {"environment": env, "seeds": seeds, "nugget": nugget, "kept": kept}
    if quiet is not None:
        source["quiet"] = quiet
    prior = fit_prior_from_episodes(
        entry(env).world, parse_seeds(seeds), link=link.value, nugget=nugget,
        variance_cutoff=kept, quiet_threshold=quiet, source=source)
    prior.save(out)
    options.echo(f"{out}: {prior.modes.shape[1]} modes across {len(prior.points)} nodes of the "
                f"inlet, correlated over {prior.correlation_steps} steps of {prior.time_step:g} s")
    if prior.regimes is not None:
        options.echo(f"slugs enter {prior.regimes.share:.0%} of the time and last "
                    f"{1.0 / prior.regimes.p_end:.1f} steps on average")


@fit.command("model", cls=options.Command)
def fit_model(
    env: options.EnvironmentId,
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write, npz.")],
    seeds: options.TrainSeeds = "train:0-199",
    modes: Annotated[int, typer.Option(
        min=1, help="Number of concentration modes; more make filters slower.")] = 64,
    correct: Annotated[bool, typer.Option(
        "--correct", help="Fit only the residual of the task's flow model; needs fewer episodes.",
    )] = False,
    linearised: Annotated[bool, typer.Option(
        "--linearised", help="Linearise voltages once, about the homogeneous estimate, and fit the "
                             "covariance of the residuals.")] = False,
) -> None:
    """Fit a model for filters (`eitbench.estimation.IdentifiedModel`) to training episodes: the
    impulse response of the concentration to the inflow, and the residual statistics. Missing
    episodes are simulated on one core; `eitbench bank` uses all cores."""
    from tqdm import tqdm

    import eitbench
    from eitbench.estimation import identify_model
    from eitbench.measured.quality import percent
    examples = eitbench.dataset(env, seeds)
    model = identify_model(
        examples, modes=modes, residual_only=correct, linearised=linearised,
        progress=lambda each: tqdm(each, desc="learning", unit="episode", disable=None),
        source={"environment": env, "seeds": seeds, "modes": modes}
        | dict.fromkeys(["correct"] * correct + ["linearised"] * linearised, True))
    model.save(out)
    left = float(model.residual_covariance.trace() / examples.mass.sum())
    options.echo(f"{out}: {modes} modes of the concentration, impulse response of "
                f"{model.impulse_response.shape[1]} steps; root mean square residual "
                f"{percent(left**0.5)}")
