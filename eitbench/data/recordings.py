"""Recordings: what an environment plays and scores an episode from, without any mesh of the truth.

The score (5.12) needs of the truth only two integrals a step and one vector on the estimator's
nodes. With P the interpolation to the truth's nodes, M its mass matrix, and everything counted from
the world's background,
    ∫(ĉ − c)² = ĉᵀ M̃ ĉ − 2 ĉᵀ b_t + d_t,      M̃ = Pᵀ M P,   b_t = Pᵀ M c_t,   d_t = c_tᵀ M c_t.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from eitbench import _check
from eitbench._files import write_atomically
from eitbench.data import kits, store
from eitbench.data.episodes import Episode, once, simulate, truth_discretisation
from eitbench.worlds.streams import randomness
from eitbench.worlds.task import make_task

if TYPE_CHECKING:
    import scipy.sparse as sp

    from eitbench.physics.profiles import VelocityModel
    from eitbench.worlds.instrument import Faults
    from eitbench.worlds.world import World

SPARSE = ("data", "indices", "indptr")
"""Arrays that hold a sparse matrix."""
OUTLINE = (*SPARSE, "largest")
"""Those that hold an `Outline`."""


class Outline(NamedTuple):
    """What all episodes of a world have in common, as far as playing and scoring need it."""

    mass: sp.csr_array
    """(n, n) triangle of M̃, m² (m³ in 3D), doubled beside the diagonal: ĉᵀ·mass·ĉ = ĉᵀM̃ĉ."""
    largest_voltage: float
    """V, of the cycle's injections into liquid of the expected concentration."""


def recording(world: World, seed: int) -> np.ndarray:
    """The recording of an episode, from the cache if it is there; else it is simulated.

    Returns
    -------
    (T,) structured array, read-only and memory-mapped, one entry for each t = 1 … T:

    ``transfer_resistance``  (L, L) 𝓡 in Ω (Ω·m in 2D)
    ``noise``                (L,) standard normal draws
    ``moment``               (n,) float32, b_t: scores are exact to 2e-10
    ``deviation``            ∫(c_t − background)²
    ``square``               ∫c_t²
    ``velocity_moment``      (k,) ∫φ_k v_t across the pipe, where the flow is asked for too
    ``velocity_square``      ∫v_t², there too
    ``checksum``             of all these bytes
    """
    seed = _check.integer("seed", seed, low=0)
    stored = _load(world, seed)
    if stored is None:
        stored = make_recording(world, seed, simulate(world, seed))
        path = recording_path(world, seed)
        try:
            store_recording(path, stored)
        except OSError as error:
            store.warn_not_kept(path.parent, error)
    return stored


def recording_path(world: World, seed: int) -> Path:
    """Where the recording of an episode is kept."""
    return store.folder(world) / f"{seed}.npy"


def is_recorded(world: World, seed: int) -> bool:
    """Whether a sound recording is there."""
    return _load(world, seed) is not None


def make_recording(world: World, seed: int, episode: Episode) -> np.ndarray:
    """The recording of ``episode``, which `simulate` gives for this seed."""
    operators = score_operators(world)
    velocity = world.velocity_model
    entries = np.zeros(len(episode.noise), recording_type(world, operators[0].shape[1]))
    entries["transfer_resistance"] = episode.transfer_resistance
    entries["noise"] = episode.noise
    entries["moment"], entries["deviation"], entries["square"] = integrate(
        episode, world.background, *operators)
    if velocity is not None:
        entries["velocity_moment"] = (episode.velocity * velocity.weights) @ velocity.profiles
        entries["velocity_square"] = episode.velocity**2 @ velocity.weights
    entries["checksum"] = _checksums(entries, seed)
    entries.setflags(write=False)
    return entries


def integrate(episode: Episode, background: float, interpolation: sp.csr_array, mass: sp.csr_array,
              ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """b_t (T, n), ∫(c_t − background)² and ∫c_t² (T,) of an episode, for these P and M."""
    c = episode.concentration[1:].astype(float)
    deviation = c - background
    weighted = mass @ deviation.T
    return ((interpolation.T @ weighted).T, np.einsum("tn,nt->t", deviation, weighted),
            np.einsum("tn,nt->t", c, mass @ c.T))


def store_recording(path: Path, entries: np.ndarray) -> None:
    """Write a recording where `recording` finds it."""
    write_atomically(path, store.npy(entries))


def recording_type(world: World, n_nodes: int) -> np.dtype:
    """Of one step of a recording with so many nodes in the estimators' mesh."""
    L = world.vessel.n_electrodes
    velocity = world.velocity_model
    flow = [] if velocity is None else [
        ("velocity_moment", "<f8", (velocity.size,)), ("velocity_square", "<f8")]
    return np.dtype([("transfer_resistance", "<f8", (L, L)), ("noise", "<f8", (L,)),
                     ("moment", "<f4", (n_nodes,)), ("deviation", "<f8"), ("square", "<f8"), *flow,
                     ("checksum", "<u4")])


def outline(world: World) -> Outline:
    """The outline of a world: shipped, or from the cache if it is there."""
    return _outline(world.fluid)


@lru_cache(maxsize=4)
def _outline(fluid: World) -> Outline:
    stored = kits.shipped_or_kept("outline", kits.outline_numbers(fluid),
                                  lambda: store.folder(fluid) / "outline.npz", OUTLINE,
                                  lambda: make_outline(fluid))
    return Outline(sparse_of(stored), float(stored["largest"]))


def make_outline(world: World) -> dict[str, np.ndarray]:
    """The arrays `OUTLINE` of a world, made anew."""
    task = make_task(world.fluid)
    level = np.full(task.mesh.n_nodes, world.expected_concentration)
    largest = np.abs(task.observation.voltages(level, world.fluid.currents)).max()
    return half_mass(*score_operators(world)) | {"largest": np.array(largest)}


def half_mass(interpolation: sp.csr_array, mass: sp.csr_array) -> dict[str, np.ndarray]:
    """`SPARSE` arrays of M̃'s upper triangle, its entries beside the diagonal doubled."""
    import scipy.sparse as sp
    full = interpolation.T @ mass @ interpolation
    half = sp.csr_array(sp.triu(full) + sp.triu(full, 1))
    return {name: getattr(half, name) for name in SPARSE}


def sparse_of(arrays: Mapping[str, np.ndarray]) -> sp.csr_array:
    """The square matrix that `SPARSE` arrays hold; read-only, since all environments share it."""
    import scipy.sparse as sp
    data, indices, indptr = (arrays[name] for name in SPARSE)
    data.setflags(write=False)
    return sp.csr_array((data, indices, indptr), shape=(len(indptr) - 1,) * 2)


@once(2)
def score_operators(world: World) -> tuple[sp.csr_array, sp.csr_array]:
    """(interpolation from the model's CD mesh to the truth's, the truth's mass matrix)."""
    from eitbench.numerics.fem import mass_matrix
    truth = truth_discretisation(world).transport.mesh
    return world.vessel.carrier(fine=False)[0].interpolation_to(truth.points), mass_matrix(truth)


def faults_of(world: World, seed: int) -> Faults:
    """What is wrong with the instrument in an episode."""
    return world.instrument.draw(randomness(seed).faults, world.vessel.n_electrodes, world.n_steps)


def cycle_voltages(world: World, seed: int, entries: np.ndarray) -> np.ndarray:
    """(T, L) noisy voltages in V of the world's injection cycle in the episode of this seed."""
    cycle = world.currents
    steps = np.arange(len(entries))
    return world.instrument.measure(faults_of(world, seed), steps + 1,
                                    entries["transfer_resistance"], cycle[steps % len(cycle)],
                                    entries["noise"])


def step_error(mass: sp.csr_array, estimate: np.ndarray, moment: np.ndarray,
               deviation: np.ndarray | float, square: np.ndarray | float) -> np.ndarray:
    """∫(ĉ_t − c_t)² / ∫c_t² for ``estimate`` (..., n) less the background, by a recording."""
    # Contiguous: else the order of the sums, and so the last bit, would depend on how many
    # estimates there are.
    quadratic = np.einsum("...n,...n->...", estimate, np.ascontiguousarray((mass @ estimate.T).T))
    return (quadratic - 2.0 * np.einsum("...n,...n->...", estimate, moment) + deviation) / square


def velocity_error(velocity: VelocityModel, parameters: np.ndarray, moment: np.ndarray,
                   square: np.ndarray | float) -> np.ndarray:
    """∫(v̂_t − v_t)² / ∫v_t² across the pipe for ``parameters`` (..., k) in m/s, by a recording."""
    gram = velocity.profiles.T @ (velocity.weights[:, None] * velocity.profiles)
    quadratic = np.einsum("...k,kl,...l->...", parameters, gram, parameters)
    return (quadratic - 2.0 * np.einsum("...k,...k->...", parameters, moment) + square) / square


_sound: dict[Path, tuple[int, int]] = {}
"""Files this process has read whole and found in order: size and time of change."""


def _load(world: World, seed: int) -> np.ndarray | None:
    path = recording_path(world, seed)
    kind, header, length = _layout(world.fluid)
    try:
        status = os.stat(path)
        entries = np.asarray(np.memmap(path, kind, "r", len(header), (length,)))
        if _sound.get(path) != (status.st_size, status.st_mtime_ns):
            with path.open("rb") as file:
                begins_well = file.read(len(header)) == header
            if not begins_well or (entries["checksum"] != _checksums(entries, seed)).any():
                return None
            _sound[path] = status.st_size, status.st_mtime_ns
        return entries
    except (FileNotFoundError, IsADirectoryError, ValueError):  # missing, no file, cut short
        return None


@lru_cache(maxsize=16)
def _layout(fluid: World) -> tuple[np.dtype, bytes, int]:
    """Of a recording's file: the type of a step, what numpy writes before them, their number."""
    kind = recording_type(fluid, outline(fluid).mass.shape[0])
    content = store.npy(np.zeros(fluid.n_steps, kind))
    return kind, content[:-fluid.n_steps * kind.itemsize], fluid.n_steps


def _checksums(entries: np.ndarray, seed: int) -> np.ndarray:
    """Of each step's bytes, and of the seed: a file under another's name is not believed."""
    raw = np.ascontiguousarray(entries).view(np.uint8).reshape(len(entries), -1)[:, :-4]
    return np.array([zlib.crc32(row.data, seed) for row in raw], dtype=np.uint32)
