"""Recordings: the part of a simulated episode that environments play and score it from.

Scores need of the truth only two integrals a step and one vector on the estimators' nodes
(`eitbench.data.regions`), and none of its meshes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from eitbench import _check
from eitbench.data import cache
from eitbench.data.episodes import Episode, simulate
from eitbench.data.regions import (  # noqa: F401 (outline, score_operators: for users of both)
    integrate,
    make_integrals,
    outline,
    score_operators,
)
from eitbench.worlds.streams import randomness

if TYPE_CHECKING:
    from pathlib import Path

    import scipy.sparse as sp

    from eitbench.physics.profiles import VelocityModel
    from eitbench.worlds.instrument import Faults
    from eitbench.worlds.world import World


def recording(world: World, seed: int) -> np.ndarray:
    """Return the recording of an episode, from the cache or simulated.

    Returns
    -------
    (T,) structured array, read-only and memory-mapped, one entry for each t = 1 … T:

    ``transfer_resistance``  (L, L) 𝓡 in Ω (Ω·m in 2D)
    ``noise``                (L,) standard normal draws
    ``moment``               (n,) float32, b_t: scores are exact to 2e-10
    ``deviation``            ∫(c_t − background)²
    ``square``               ∫c_t²
    ``region_…``             the last three over the world's region, if it has one
    ``velocity_moment``      (k,) ∫φ_k v_t across the pipe, where the flow is to be estimated too
    ``velocity_square``      ∫v_t², there too
    """
    seed = _check.integer("seed", seed, low=0)

    def build() -> dict[str, np.ndarray]:
        return {"steps": make_recording(world, seed, simulate(world, seed))}

    return cache.cached(recording_key(world, seed), build)["steps"]


def recording_key(world: World, seed: int) -> cache.Key:
    """Return the key of an episode's recording."""
    return cache.episode_key(world, str(seed))


def recording_path(world: World, seed: int) -> Path:
    """Return the file of an episode's recording in the cache."""
    return recording_key(world, seed).path


def is_recorded(world: World, seed: int) -> bool:
    """Return whether the cache holds a sound recording."""
    return cache.is_cached(recording_key(world, seed))


def make_recording(world: World, seed: int, episode: Episode) -> np.ndarray:
    """Compute the recording of ``episode``, which `simulate` returns for this seed."""
    operators = score_operators(world)
    velocity = world.velocity_model
    entries = np.zeros(len(episode.noise), recording_type(world, operators[0].shape[1]))
    entries["transfer_resistance"] = episode.transfer_resistance
    entries["noise"] = episode.noise
    for name, array in integrate(episode, world.background, *operators)._asdict().items():
        entries[name] = array
    if world.region is not None:
        for name, array in make_integrals(world, episode)._asdict().items():
            entries[f"region_{name}"] = array
    if velocity is not None:
        entries["velocity_moment"] = (episode.velocity * velocity.weights) @ velocity.profiles
        entries["velocity_square"] = episode.velocity**2 @ velocity.weights
    entries.setflags(write=False)
    return entries


def recording_type(world: World, n_nodes: int) -> np.dtype:
    """Return the type of one step of a recording; ``n_nodes`` are those of the estimators' mesh."""
    L = world.vessel.n_electrodes
    prefixes = ("",) if world.region is None else ("", "region_")
    scores = [(prefix + name, *layout) for prefix in prefixes for name, *layout in (
        ("moment", "<f4", (n_nodes,)), ("deviation", "<f8"), ("square", "<f8"))]
    velocity = world.velocity_model
    flow = [] if velocity is None else [
        ("velocity_moment", "<f8", (velocity.size,)), ("velocity_square", "<f8")]
    return np.dtype([("transfer_resistance", "<f8", (L, L)), ("noise", "<f8", (L,)),
                     *scores, *flow])


def faults_of(world: World, seed: int) -> Faults:
    """Return the faults of the instrument in an episode."""
    return world.instrument.draw(randomness(seed).faults, world.vessel.n_electrodes, world.n_steps)


def cycle_voltages(world: World, seed: int, entries: np.ndarray) -> np.ndarray:
    """Return the noisy voltages (T, L) in V of the world's injection cycle in an episode."""
    cycle = world.currents
    steps = np.arange(len(entries))
    return world.instrument.measure(faults_of(world, seed), steps + 1,
                                    entries["transfer_resistance"], cycle[steps % len(cycle)],
                                    entries["noise"])


def step_error(mass: sp.csr_array, estimate: np.ndarray, moment: np.ndarray,
               deviation: np.ndarray | float, square: np.ndarray | float) -> np.ndarray:
    """Return ∫(ĉ_t − c_t)² / ∫c_t² of ``estimate`` (..., n) less the background, by a recording."""
    # Contiguous: otherwise the order of the sums, and so the last bit, depends on the number of
    # estimates.
    quadratic = np.einsum("...n,...n->...", estimate, np.ascontiguousarray((mass @ estimate.T).T))
    return (quadratic - 2.0 * np.einsum("...n,...n->...", estimate, moment) + deviation) / square


def velocity_error(velocity: VelocityModel, parameters: np.ndarray, moment: np.ndarray,
                   square: np.ndarray | float) -> np.ndarray:
    """Return ∫(v̂_t − v_t)² / ∫v_t² across the pipe of ``parameters`` (..., k) in m/s, by a
    recording."""
    gram = velocity.profiles.T @ (velocity.weights[:, None] * velocity.profiles)
    quadratic = np.einsum("...k,kl,...l->...", parameters, gram, parameters)
    return (quadratic - 2.0 * np.einsum("...k,...k->...", parameters, moment) + square) / square
