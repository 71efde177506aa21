"""World cards: reference numbers of a few episodes of each registered id, committed, by which a change of numbers shows.

What must not change silently are numbers, not the text of the code: a card that no longer agrees means that the id needs
a new version. Numbers are compared relative to the largest of their kind, with a tolerance that other processors, BLAS
kernels and thread counts pass.
"""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from eitbench._files import PACKAGE
from eitbench.data.episodes import Episode, truth_discretisation
from eitbench.data.recordings import cycle_voltages, faults_of, make_recording, step_error
from eitbench.data.regions import make_integrals, score_mass
from eitbench.data.seeds import name_seed, parse_seeds
from eitbench.worlds.registry import entry
from eitbench.worlds.streams import randomness
from eitbench.worlds.task import make_task
from eitbench.worlds.world import World

CARDS = PACKAGE / "worlds" / "cards"
"""Where they lie: one file an id."""
SEEDS = ("train:0", "dev:0")
"""The episodes of a card."""
LAST = 24
"""Only so many injections are simulated: the first scored ones are among them in every world of ours."""
TOLERANCE = 1e-6
"""Relative difference that is none; moments are kept in single precision."""


def card(id: str) -> dict[str, Any]:
    """The numbers of an id, simulated anew: of its model, and of the first injections of two episodes.

    Returns
    -------
    dict
        JSON-ready: ``model`` (voltages in V that it computes, a step of its transport in mol/m³), and for each of
        ``episodes`` some entries of 𝓡 in Ω, noise draws, voltages in V, moments b_t, ∫(c − background)², ∫c², the
        flow's moments, faults, ĉ_bh in mol/m³, and the relative error of that estimate.
    """
    world = entry(id).world
    return {"id": id, "model": _model_numbers(world.fluid), "episodes": {
        name: _episode_numbers(world, parse_seeds(name)[0], episode)
        for name, episode in zip(SEEDS, _episodes(world.fluid), strict=True)}}


def differences(made: Any, kept: Any, place: str = "") -> list[str]:
    """A sentence for each number of two cards that differs by more than `TOLERANCE` of the largest of its kind."""
    if isinstance(kept, dict):
        if not isinstance(made, dict) or made.keys() != kept.keys():
            return [f"{place} has other names"]
        return [line for name in kept for line in differences(made[name], kept[name], f"{place}.{name}".lstrip("."))]
    if isinstance(kept, str):
        return [] if made == kept else [f"{place} is {made!r}, the card says {kept!r}"]
    new = np.asarray(made, dtype=float)
    old = np.asarray(kept, dtype=float)
    if new.shape != old.shape:
        return [f"{place} has shape {new.shape}, on the card {old.shape}"]
    scale = np.abs(old).max(initial=0.0)
    off = np.abs(new - old).max(initial=0.0)
    return [f"{place} differs by {off / scale if scale else off:.2g}"] if off > TOLERANCE * scale else []


def path_of(id: str) -> Path:
    """Where the card of an id of ours lies."""
    return CARDS / f"{id.replace('/', '-')}.json"


def text_of(made: dict[str, Any]) -> str:
    """The card as it is committed: ten digits, a line for each kind of number."""
    return json.dumps(_rounded(made), indent=1) + "\n"


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _rounded(inner) for name, inner in value.items()}
    if isinstance(value, str):
        return value
    return [float(f"{number:.10g}") for number in np.ravel(value)]


def _some(values: np.ndarray) -> np.ndarray:
    """A few entries of (n,), and their sum."""
    n = len(values)
    return np.append(values[[0, n // 3, n // 2, n - 1]].astype(float), values.sum(dtype=float))


@lru_cache(maxsize=2)
def _model_numbers(world: World) -> dict[str, Any]:
    task = make_task(world)
    level = np.full(task.mesh.n_nodes, world.expected_concentration)
    wave = level * (1.0 + 0.2 * np.sin(np.arange(task.mesh.n_nodes)))
    moved = task.transport.step(wave, world.expected_concentration, 1.1 * world.expected_concentration)
    return {"homogeneous": task.observation.voltages(level, world.currents[:1])[0],
            "wave": task.observation.voltages(wave, world.currents[:1])[0], "step": _some(moved)}


@lru_cache(maxsize=2)
def _episodes(world: World) -> list[Episode]:
    """The first injections of each episode."""
    truth = truth_discretisation(world)
    streams = [randomness(parse_seeds(name)[0]) for name in SEEDS]
    last = min(LAST, world.n_steps)
    made = []
    for history, random in zip(world.evolve(streams, truth, lambda _: None, last), streams, strict=True):
        noise = random.noise.standard_normal((world.n_steps, world.vessel.n_electrodes))[:last]
        resistance = truth.observation.transfer_resistance(history.concentration[1:])
        made.append(Episode(history.concentration.astype(np.float32), resistance, noise, history.velocity))
    return made


def _episode_numbers(world: World, seed: int, episode: Episode) -> dict[str, Any]:
    from eitbench.estimation import best_homogeneous
    task = make_task(world.fluid)
    L = world.vessel.n_electrodes
    entries = make_recording(world, seed, episode)
    moments, deviations, squares = make_integrals(world, episode) if world.region else (
        entries["moment"], entries["deviation"], entries["square"])
    voltages = cycle_voltages(world, seed, entries)
    sound = cycle_voltages(world.sound, seed, entries)[:world.calibration]
    cycle = world.currents[np.arange(world.calibration) % len(world.currents)]
    homogeneous = best_homogeneous(task.observation, world.noise, task.mesh.n_nodes, sound, cycle,
                                   world.expected_concentration)
    level = np.full(task.mesh.n_nodes, homogeneous - world.background)
    errors = [float(step_error(score_mass(world), level, moments[k], deviations[k], squares[k]))
              for k in range(world.warm_up, len(entries))]
    faults = faults_of(world, seed)
    steps = [0, 8, len(entries) - 1]
    numbers = {
        "seed": name_seed(seed),
        "resistance": entries["transfer_resistance"][steps][:, [0, 0, 1, L // 2], [1, L // 2, L - 1, L // 2]],
        "noise": entries["noise"][steps][:, [0, L - 1]], "voltages": voltages[steps][:, [0, L // 2, L - 1]],
        "moment": np.array([_some(moments[k]) for k in steps]), "deviation": deviations[steps],
        "square": squares[steps], "homogeneous": homogeneous, "floor": float(np.mean(errors)),
        "broken_from": faults.broken_from, "loose": faults.resistance}
    if world.velocity_model is not None:
        flow = entries["velocity_moment"][steps]
        numbers["velocity"] = np.column_stack([flow, entries["velocity_square"][steps]])
    return numbers
