"""Recordings: what an environment plays and scores an episode from, without any mesh of the truth.

The score (5.12) needs of the truth only two integrals a step and one vector on the estimator's nodes. With P the
interpolation to the truth's nodes, M its mass matrix, and everything counted from the scenario's background,
    ∫(ĉ − c)² = ĉᵀ M̃ ĉ − 2 ĉᵀ b_t + d_t,      M̃ = Pᵀ M P,   b_t = Pᵀ M c_t,   d_t = c_tᵀ M c_t.
"""

from __future__ import annotations

import io
import os
import zlib
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from eitbench import _check
from eitbench._files import write_atomically
from eitbench.data.episodes import Episode, folder, simulate, truth_discretisation, warn_not_kept

if TYPE_CHECKING:
    import scipy.sparse as sp

    from eitbench.physics.profiles import VelocityModel
    from eitbench.worlds.base import Scenario


class Outline(NamedTuple):
    """What all episodes of a scenario have in common, as far as playing and scoring need it."""

    mass: sp.csr_array
    """(n, n) upper triangle of M̃ in m² (m³ in 3D), entries beside the diagonal doubled: ĉᵀ·mass·ĉ = ĉᵀ M̃ ĉ."""
    largest_voltage: float
    """V, of the cycle's injections into liquid of the expected concentration."""


def recording(scenario: Scenario, seed: int) -> np.ndarray:
    """The recording of an episode, from the cache if it is there; else it is simulated.

    Returns
    -------
    (T,) structured array, read-only and memory-mapped, one entry for each t = 1 … T:

    ``transfer_resistance``  (L, L) 𝓡 in Ω (Ω·m in 2D)
    ``noise``                (L,) standard normal draws
    ``moment``               (n,) float32, b_t: scores are exact to 2e-10
    ``deviation``            ∫(c_t − background)²
    ``square``               ∫c_t²
    ``velocity_moment``      (k,) ∫φ_k v_t across the pipe; this and the next only where the flow is asked for too
    ``velocity_square``      ∫v_t²
    ``checksum``             of all these bytes
    """
    seed = _check.integer("seed", seed, low=0)
    path = recording_path(scenario, seed)
    stored = _load(scenario, seed)
    if stored is None:
        stored = make_recording(scenario, seed, simulate(scenario, seed))
        try:
            store_recording(path, stored)
        except OSError as error:
            warn_not_kept(path.parent, error)
    return stored


def recording_path(scenario: Scenario, seed: int) -> Path:
    """Where the recording of an episode is kept."""
    return folder(scenario) / f"{seed}.npy"


def is_recorded(scenario: Scenario, seed: int) -> bool:
    """Whether a sound recording is there."""
    return _load(scenario, seed) is not None


def make_recording(scenario: Scenario, seed: int, episode: Episode) -> np.ndarray:
    """The recording of ``episode``, which `simulate` gives for this seed."""
    interpolation, mass = score_operators(scenario)
    c = episode.concentration[1:].astype(float)
    deviation = c - scenario.background
    weighted = mass @ deviation.T
    n_steps = len(episode.noise)
    velocity = scenario.velocity_model
    entries = np.zeros(n_steps, recording_type(scenario, interpolation.shape[1]))
    entries["transfer_resistance"], entries["noise"] = episode.transfer_resistance, episode.noise
    entries["moment"] = (interpolation.T @ weighted).T
    entries["deviation"] = np.einsum("tn,nt->t", deviation, weighted)
    entries["square"] = np.einsum("tn,nt->t", c, mass @ c.T)
    if velocity is not None:
        entries["velocity_moment"] = (episode.velocity * velocity.weights) @ velocity.profiles
        entries["velocity_square"] = episode.velocity**2 @ velocity.weights
    entries["checksum"] = _checksums(entries, seed)
    entries.setflags(write=False)
    return entries


def store_recording(path: Path, entries: np.ndarray) -> None:
    """Write a recording where `recording` finds it."""
    content = io.BytesIO()
    np.save(content, entries)
    write_atomically(path, content.getvalue())


def recording_type(scenario: Scenario, n_nodes: int) -> np.dtype:
    """Of one step of a recording with so many nodes in the estimators' mesh."""
    n_electrodes, velocity = scenario.currents.shape[1], scenario.velocity_model
    flow = [] if velocity is None else [("velocity_moment", "<f8", (velocity.size,)), ("velocity_square", "<f8")]
    return np.dtype([("transfer_resistance", "<f8", (n_electrodes, n_electrodes)), ("noise", "<f8", (n_electrodes,)),
                     ("moment", "<f4", (n_nodes,)), ("deviation", "<f8"), ("square", "<f8"), *flow,
                     ("checksum", "<u4")])


@lru_cache(maxsize=4)
def outline(scenario: Scenario) -> Outline:
    """The outline of a scenario, from the cache if it is there."""
    import scipy.sparse as sp
    path = folder(scenario) / "outline.npz"
    stored = _load_outline(path)
    if stored is None:
        interpolation, mass = score_operators(scenario)
        full = sp.csr_array(interpolation.T @ mass @ interpolation)
        half = sp.csr_array(sp.triu(full) + sp.triu(full, 1))
        n_nodes, model = full.shape[0], scenario.model()
        level = np.full(n_nodes, scenario.expected_concentration)
        largest = np.abs(model.observation.voltages(level, scenario.currents)).max()
        arrays = (half.data, half.indices, half.indptr, np.array(largest))
        content = io.BytesIO()
        np.savez(content, *arrays, checksum=zlib.crc32(b"".join(array.tobytes() for array in arrays)))
        try:
            write_atomically(path, content.getvalue())
        except OSError as error:
            warn_not_kept(path.parent, error)
        stored = half.data, half.indices, half.indptr, largest
    data, indices, indptr, largest = stored
    data.setflags(write=False)                             # shared by all environments
    return Outline(sp.csr_array((data, indices, indptr), shape=(len(indptr) - 1,) * 2), float(largest))


@lru_cache(maxsize=2)
def score_operators(scenario: Scenario) -> tuple[sp.csr_array, sp.csr_array]:
    """(interpolation from the model's CD mesh to the truth's, the truth's mass matrix)."""
    from eitbench.numerics.fem import mass_matrix
    truth = truth_discretisation(scenario).transport.mesh
    return scenario.model().transport.mesh.interpolation_to(truth.points), mass_matrix(truth)


def cycle_voltages(scenario: Scenario, entries: np.ndarray) -> np.ndarray:
    """(T, L) noisy voltages in V of the scenario's injection cycle."""
    cycle = scenario.currents
    currents = cycle[np.arange(len(entries)) % len(cycle)]
    clean = np.einsum("tml,tl->tm", entries["transfer_resistance"], currents)
    return clean + scenario.noise.std(clean) * entries["noise"]


def step_error(mass: sp.csr_array, estimate: np.ndarray, moment: np.ndarray, deviation: np.ndarray | float,
               square: np.ndarray | float) -> np.ndarray:
    """∫(ĉ_t − c_t)² / ∫c_t² for ``estimate`` (..., n) less the background, with the entries of recordings."""
    # Contiguous: else the order of the sums, and so the last bit, would depend on how many estimates there are.
    quadratic = np.einsum("...n,...n->...", estimate, np.ascontiguousarray((mass @ estimate.T).T))
    return (quadratic - 2.0 * np.einsum("...n,...n->...", estimate, moment) + deviation) / square


def velocity_error(velocity: VelocityModel, parameters: np.ndarray, moment: np.ndarray, square: np.ndarray | float,
                   ) -> np.ndarray:
    """∫(v̂_t − v_t)² / ∫v_t² across the pipe for ``parameters`` (..., k) in m/s, with the entries of recordings."""
    gram = velocity.profiles.T @ (velocity.weights[:, None] * velocity.profiles)
    quadratic = np.einsum("...k,kl,...l->...", parameters, gram, parameters)
    return (quadratic - 2.0 * np.einsum("...k,...k->...", parameters, moment) + square) / square


_sound: dict[Path, tuple[int, int]] = {}
"""Files this process has read whole and found in order: size and time of change."""


def _load(scenario: Scenario, seed: int) -> np.ndarray | None:
    path, (kind, header, length) = recording_path(scenario, seed), _layout(scenario)
    try:
        status = os.stat(path)
        entries = np.asarray(np.memmap(path, kind, "r", len(header), (length,)))
        if _sound.get(path) != (status.st_size, status.st_mtime_ns):
            with path.open("rb") as file:
                if file.read(len(header)) != header or (entries["checksum"] != _checksums(entries, seed)).any():
                    return None
            _sound[path] = status.st_size, status.st_mtime_ns
        return entries
    except (FileNotFoundError, ValueError):        # missing, cut short
        return None


@lru_cache(maxsize=16)
def _layout(scenario: Scenario) -> tuple[np.dtype, bytes, int]:
    """Of a recording's file: the type of a step, what numpy writes before the first, and their number."""
    kind, content = recording_type(scenario, outline(scenario).mass.shape[0]), io.BytesIO()
    np.save(content, np.zeros(scenario.n_steps, kind))
    return kind, content.getvalue()[:-scenario.n_steps * kind.itemsize], scenario.n_steps


def _checksums(entries: np.ndarray, seed: int) -> np.ndarray:
    """Of each step's bytes, and of the seed: a file under another's name is not believed."""
    raw = np.ascontiguousarray(entries).view(np.uint8).reshape(len(entries), -1)[:, :-4]
    return np.array([zlib.crc32(row.data, seed) for row in raw], dtype=np.uint32)


def _load_outline(path: Path) -> tuple | None:
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = tuple(stored[f"arr_{k}"] for k in range(4))
            sound = int(stored["checksum"]) == zlib.crc32(b"".join(array.tobytes() for array in arrays))
            return arrays if sound else None
    except Exception:       # a damaged archive may raise anything
        return None
