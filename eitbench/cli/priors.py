"""The command `fit-prior`: what training episodes teach of the inflow."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from eitbench.cli import options

Link = StrEnum("Link", ["logarithm", "linear"])


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
) -> None:
    """Learn what to expect of the inflow from training episodes, which are not simulated for it,
    and write it as a prior for filters (`eitbench.estimation.InflowPrior`)."""
    from eitbench.data.seeds import parse_seeds
    from eitbench.estimation import learned_inflow_prior
    from eitbench.worlds.registry import entry
    with options.clear_errors():
        prior = learned_inflow_prior(
            entry(env).world, parse_seeds(seeds), link=link.value, nugget=nugget, kept=kept,
            source={"environment": env, "seeds": seeds, "nugget": nugget, "kept": kept})
        prior.save(out)
    options.say(f"{out}: {prior.modes.shape[1]} modes across {len(prior.points)} nodes of the "
                f"inlet, correlated over {prior.memory} steps of {prior.time_step:g} s")
