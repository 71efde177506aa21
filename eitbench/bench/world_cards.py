"""World cards: committed numbers of a few episodes of each registered id: a change shows.

What must not change silently are numbers, not the text of the code: a card that no longer agrees
means that the id needs a new version. Numbers are compared relative to the largest of their kind,
with a tolerance that other processors, BLAS kernels and thread counts pass.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from eitbench._files import PACKAGE, write_atomically
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
"""So many injections are simulated: the first scored ones are among them in our worlds."""
TOLERANCE = 1e-6
"""Relative difference that is none; moments are kept in single precision."""


def card(id: str) -> dict[str, Any]:
    """The card of a registered id, simulated anew; see `numbers`."""
    return {"id": id} | numbers(entry(id).world)


@lru_cache(maxsize=2)
def numbers(world: World) -> dict[str, Any]:
    """What stands on the card of a world: its model, and the first injections of two episodes.

    Returns
    -------
    dict
        JSON-ready: ``model`` (voltages in V that it computes, a step of its transport in mol/m³),
        and for each of ``episodes`` some entries of 𝓡 in Ω, noise draws, voltages in V, moments
        b_t, ∫(c − background)², ∫c², the flow's moments, faults, ĉ_bh in mol/m³, and the relative
        error of that estimate.
    """
    return {"model": _model_numbers(world.fluid), "episodes": {
        name: _episode_numbers(world, parse_seeds(name)[0], episode)
        for name, episode in zip(SEEDS, _episodes(world.fluid), strict=True)}}


def disagreements(id: str) -> list[str]:
    """A sentence for each number that is not as on the card; one if that is missing or damaged."""
    try:
        kept = json.loads(path_of(id).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return [f"{id} has no card: {path_of(id)} is missing"]
    except ValueError as error:                                 # no JSON, no UTF-8
        return [f"the card of {id} is damaged: {error}"]
    made = json.loads(text_of(card(id)))
    return [f"{id}: {sentence}" for sentence in differences(made, kept)]


def differences(made: Any, kept: Any, place: str = "") -> list[str]:
    """A sentence for each number of two cards that differs by more than `TOLERANCE` of the largest
    of its kind; both as they are read from JSON."""
    if isinstance(made, dict) and isinstance(kept, dict):
        if made.keys() != kept.keys():
            others = ", ".join(sorted(made.keys() ^ kept.keys()))
            return [f"{place or 'the card'} has other names: {others}"]
        return [line for name in kept
                for line in differences(made[name], kept[name], f"{place}.{name}".lstrip("."))]
    if not (isinstance(made, list) and isinstance(kept, list)):
        return [] if made == kept else [f"{place} is {made!r}, the card says {kept!r}"]
    if len(made) != len(kept):
        return [f"{place} are {len(made)} numbers, on the card {len(kept)}"]
    try:
        new, old = np.array(made, dtype=float), np.array(kept, dtype=float)
    except (TypeError, ValueError):
        return [f"{place} on the card are no numbers"]
    scale = np.abs(old).max(initial=0.0)
    off = np.abs(new - old)
    if (off <= TOLERANCE * scale).all():                        # false for NaN too
        return []
    worst = int(np.nanargmax(off)) if np.isfinite(off).any() else 0
    return [f"{place} differs by {off[worst] / (scale or 1.0):.2g} of its largest: number {worst} "
            f"is {new[worst]:.10g}, the card says {old[worst]:.10g}"]


def update(ids: Iterable[str]) -> Iterator[tuple[str, str, list[str]]]:
    """Compare the cards of these ids, and write those that are missing; one whose numbers have
    moved stays as it is.

    Yields
    ------
    id, what, differences
        ``what`` is ``new``, ``same`` or ``moved``.
    """
    for id in ids:
        if not path_of(id).is_file():
            write_atomically(path_of(id), text_of(card(id)).encode())
            yield id, "new", []
            continue
        moved = disagreements(id)
        yield id, "moved" if moved else "same", moved


def path_of(id: str) -> Path:
    """Where the card of an id of ours lies."""
    return CARDS / f"{id.replace('/', '-')}.json"


def text_of(made: dict[str, Any]) -> str:
    """The card as it is committed: ten digits, a line for each number."""
    return json.dumps(_rounded(made), indent=1) + "\n"


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _rounded(inner) for name, inner in value.items()}
    if isinstance(value, str):
        return value
    return [float(f"{number:.10g}") for number in np.ravel(value)]


def _some(values: np.ndarray) -> np.ndarray:
    """A few entries of (n,), and the mean of all."""
    n = len(values)
    return np.append(values[[0, n // 3, n // 2, n - 1]].astype(float), values.mean(dtype=float))


@lru_cache(maxsize=2)
def _model_numbers(world: World) -> dict[str, Any]:
    task = make_task(world)
    level = np.full(task.mesh.n_nodes, world.expected_concentration)
    wave = level * (1.0 + 0.2 * np.sin(np.arange(task.mesh.n_nodes)))
    moved = task.transport.step(wave, world.expected_concentration,
                                1.1 * world.expected_concentration)
    return {"homogeneous": task.observation.voltages(level, world.currents[:1])[0],
            "wave": task.observation.voltages(wave, world.currents[:1])[0], "step": _some(moved)}


def _shown(last: int) -> list[int]:
    """Of so many injections those, counted from 0, whose numbers stand on the card."""
    return [0, 8, last - 1]


@lru_cache(maxsize=2)
def _episodes(world: World) -> list[Episode]:
    """The first injections of each episode; 𝓡 is not a number where the card has no use for it."""
    truth = truth_discretisation(world)
    streams = [randomness(parse_seeds(name)[0]) for name in SEEDS]
    last = min(LAST, world.n_steps)
    used = sorted({*range(world.calibration), *_shown(last)})
    L = world.vessel.n_electrodes
    made = []
    for history, random in zip(world.evolve(streams, truth, lambda _: None, last), streams,
                               strict=True):
        noise = random.noise.standard_normal((world.n_steps, L))[:last]
        states = history.concentration[1:]
        resistance = np.full((last, L, L), np.nan)
        observation = world.true_observation(truth, random.contacts)
        resistance[used] = observation.transfer_resistance(states[used])
        made.append(Episode(history.concentration.astype(np.float32), resistance, noise,
                            history.velocity))
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
    steps = _shown(len(entries))
    shown = {
        "seed": name_seed(seed),
        "resistance": entries["transfer_resistance"][steps][:, [0, 0, 1, L // 2],
                                                            [1, L // 2, L - 1, L // 2]],
        "noise": entries["noise"][steps][:, [0, L - 1]],
        "voltages": voltages[steps][:, [0, L // 2, L - 1]],
        "moment": np.array([_some(moments[k]) for k in steps]), "deviation": deviations[steps],
        "square": squares[steps], "homogeneous": homogeneous, "floor": float(np.mean(errors)),
        "broken_from": faults.broken_from, "loose": faults.resistance}
    if world.velocity_model is not None:
        flow = entries["velocity_moment"][steps]
        shown["velocity"] = np.column_stack([flow, entries["velocity_square"][steps]])
    return shown
