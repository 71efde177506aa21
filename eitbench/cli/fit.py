"""The commands `fit prior` and `fit model`: learn inflow and flow from training episodes."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from eitbench.cli import options

Link = StrEnum("Link", ["logarithm", "linear"])

app = typer.Typer(no_args_is_help=True, help="Fit priors and models to training episodes.")


@app.command("prior")
def fit_prior(
    env: Annotated[str, typer.Option(help="Id of an environment whose world has an inflow.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write, JSON.")],
    seeds: Annotated[str, typer.Option(help="Episodes of the split train.")] = "train:0-199",
    link: Annotated[Link, typer.Option(
        help="What is Gaussian: the inflow's logarithm, or the inflow.")] = Link.logarithm,
    nugget: Annotated[float, typer.Option(
        min=0.0, max=1.0, help="Part of the variance that is white in time.")] = 0.01,
    kept: Annotated[float, typer.Option(
        min=0.0, max=1.0, help="Modes across the inlet of less than this part of the variance are "
                               "left out; each makes filters slower.")] = 1e-4,
    quiet: Annotated[float | None, typer.Option(
        help="Learn how slugs begin and end too: a step is quiet if what is Gaussian is nowhere "
             "beyond ± this.")] = None,
) -> None:
    """Learn what to expect of the inflow from training episodes, which are not simulated for it,
    and write it as a prior for filters (`eitbench.estimation.InflowPrior`)."""
    from eitbench.data.seeds import parse_seeds
    from eitbench.estimation import learned_inflow_prior
    from eitbench.worlds.registry import entry
    regimes = {} if quiet is None else {"quiet": quiet}
    with options.clear_errors():
        prior = learned_inflow_prior(
            entry(env).world, parse_seeds(seeds), link=link.value, nugget=nugget, kept=kept,
            quiet=quiet, source={"environment": env, "seeds": seeds, "nugget": nugget,
                                 "kept": kept, **regimes})
        prior.save(out)
    options.say(f"{out}: {prior.modes.shape[1]} modes across {len(prior.points)} nodes of the "
                f"inlet, correlated over {prior.memory} steps of {prior.time_step:g} s")
    if prior.regimes is not None:
        options.say(f"slugs enter {prior.regimes.share:.0%} of the time and last "
                    f"{1.0 / prior.regimes.ends:.1f} steps on average")


@app.command("model")
def fit_model(
    env: Annotated[str, typer.Option(help="Id of an environment whose world has an inflow.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write, npz.")],
    seeds: Annotated[str, typer.Option(help="Episodes of the split train.")] = "train:0-199",
    modes: Annotated[int, typer.Option(
        min=1, help="Of the concentration; more of them make filters slower.")] = 64,
    correct: Annotated[bool, typer.Option(
        "--correct", help="Believe the flow as told, and learn only what that is off: needs fewer "
                          "episodes.")] = False,
    linearised: Annotated[bool, typer.Option(
        "--linearised", help="Linearise voltages once, about the homogeneous estimate, and learn "
                             "how readings scatter about that.")] = False,
) -> None:
    """Learn from training episodes what an inflow leaves in the pipe, and by how much that and the
    voltages are off, and write it for filters (`eitbench.estimation.IdentifiedModel`). Episodes
    that are not there yet are simulated, on one core; `eitbench bank` does so on all."""
    from tqdm import tqdm

    import eitbench
    from eitbench.estimation import identified_model
    with options.clear_errors():
        examples = eitbench.dataset(env, seeds)
        model = identified_model(
            examples, modes=modes, correct=correct, linearised=linearised,
            progress=lambda each: tqdm(each, desc="learning", unit="episode", disable=None),
            source={"environment": env, "seeds": seeds, "modes": modes}
            | {name: True for name, said in (("correct", correct), ("linearised", linearised))
               if said})
        model.save(out)
    left = float(model.spread.trace() / examples.mass.sum())
    options.say(f"{out}: {modes} modes of the concentration, which remembers "
                f"{model.weights.shape[1]} inflows; {100 * left**0.5:.2g} % (root mean square) "
                "is left")
