"""Scores of a part of the vessel: what recordings hold of the whole, restricted to a scenario's region of interest.

A scenario with a ``region`` counts errors between two cross-sections only. The integrals of
`eitbench.data.recordings` are then taken over the cells of the truth's mesh that lie between them, and kept in a file
beside the recording. Without a region they are the recording's own.
"""

from __future__ import annotations

import io
import zlib
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from eitbench._files import write_atomically
from eitbench.data.episodes import Episode, folder, simulate, truth_discretisation, warn_not_kept
from eitbench.data.recordings import outline, recording, score_operators

if TYPE_CHECKING:
    import scipy.sparse as sp

    from eitbench.numerics.mesh import Mesh
    from eitbench.worlds.base import Scenario


class Integrals(NamedTuple):
    """What an episode is scored by, t = 1 … T, over what counts; see `eitbench.data.recordings`."""

    moment: np.ndarray
    """(T, n) float32, b_t"""
    deviation: np.ndarray
    """(T,) ∫(c_t − background)²"""
    square: np.ndarray
    """(T,) ∫c_t²"""


def region_of(scenario: Scenario) -> tuple[float, float] | None:
    """The cross-sections (m along the pipe) between which errors count, None where the whole vessel does."""
    return getattr(scenario, "region", None)


def integrals(scenario: Scenario, seed: int) -> Integrals:
    """What the episode of this seed is scored by, from the cache if it is there; else it is simulated."""
    if region_of(scenario) is None:
        entries = recording(scenario, seed)
        return Integrals(entries["moment"], entries["deviation"], entries["square"])
    stored = _load(integrals_path(scenario, seed), seed)
    if stored is None:
        stored = make_integrals(scenario, simulate(scenario, seed))
        try:
            store_integrals(integrals_path(scenario, seed), seed, stored)
        except OSError as error:
            warn_not_kept(folder(scenario), error)
    return stored


def integrals_path(scenario: Scenario, seed: int) -> Path:
    """Where the integrals over a scenario's region are kept."""
    return folder(scenario) / f"{seed}.region.npz"


def are_kept(scenario: Scenario, seed: int) -> bool:
    """Whether the file of the region, if the scenario has one, is there and sound."""
    return region_of(scenario) is None or _load(integrals_path(scenario, seed), seed) is not None


def make_integrals(scenario: Scenario, episode: Episode) -> Integrals:
    """The integrals over the scenario's region; ``episode`` is its truth."""
    interpolation, mass = region_operators(scenario)
    c = episode.concentration[1:].astype(float)
    deviation = c - scenario.background
    weighted = mass @ deviation.T
    return Integrals((interpolation.T @ weighted).T.astype(np.float32), np.einsum("tn,nt->t", deviation, weighted),
                     np.einsum("tn,nt->t", c, mass @ c.T))


def store_integrals(path: Path, seed: int, made: Integrals) -> None:
    """Write the integrals of an episode where `integrals` finds them."""
    content = io.BytesIO()
    np.savez(content, checksum=_checksum(made, seed), **made._asdict())
    write_atomically(path, content.getvalue())


@lru_cache(maxsize=4)
def score_mass(scenario: Scenario) -> sp.csr_array:
    """(n, n) M̃ of what counts, its upper triangle with the entries beside the diagonal doubled, as `Outline.mass`."""
    import scipy.sparse as sp
    if region_of(scenario) is None:
        return outline(scenario).mass
    path = folder(scenario) / "region.npz"
    arrays, n = _load_arrays(path, 0, ("data", "indices", "indptr")), outline(scenario).mass.shape[0]
    if arrays is None:
        interpolation, mass = region_operators(scenario)
        full = sp.csr_array(interpolation.T @ mass @ interpolation)
        half = sp.csr_array(sp.triu(full) + sp.triu(full, 1))
        arrays = [half.data, half.indices, half.indptr]
        content = io.BytesIO()
        np.savez(content, data=half.data, indices=half.indices, indptr=half.indptr, checksum=_checksum(arrays, 0))
        try:
            write_atomically(path, content.getvalue())
        except OSError as error:
            warn_not_kept(path.parent, error)
    data, indices, indptr = arrays
    data.setflags(write=False)                             # shared by all environments
    return sp.csr_array((data, indices, indptr), shape=(n, n))


@lru_cache(maxsize=2)
def region_operators(scenario: Scenario) -> tuple[sp.csr_array, sp.csr_array]:
    """(interpolation from the model's CD mesh to the truth's, the truth's mass matrix over the region)."""
    interpolation, mass = score_operators(scenario)
    region = region_of(scenario)
    if region is None:
        return interpolation, mass
    return interpolation, mass_between(truth_discretisation(scenario).transport.mesh, *region)


def mass_between(mesh: Mesh, begin: float, end: float) -> sp.csr_array:
    """(n, n) P1 mass matrix ∫φᵢφⱼ in m² (m³ in 3D) over the cells whose centroids lie in begin < x < end (m)."""
    import scipy.sparse as sp
    middle = mesh.points[mesh.cells][:, :, 0].mean(axis=1)
    inside = (begin < middle) & (middle < end)
    cells, corners = mesh.cells[inside], mesh.dim + 1
    local = mesh.volumes[inside, None, None] * (1.0 + np.eye(corners)) / (corners * (corners + 1))
    rows, columns = np.repeat(cells, corners, axis=1), np.tile(cells, corners)
    return sp.csr_array((local.ravel(), (rows.ravel(), columns.ravel())), shape=(mesh.n_nodes,) * 2)


def _load(path: Path, seed: int) -> Integrals | None:
    arrays = _load_arrays(path, seed, Integrals._fields)
    return None if arrays is None else Integrals(*arrays)


def _load_arrays(path: Path, seed: int, names: tuple[str, ...]) -> list[np.ndarray] | None:
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = [stored[name] for name in names]
            return arrays if int(stored["checksum"]) == _checksum(arrays, seed) else None
    except Exception:       # missing or damaged: an archive may raise anything
        return None


def _checksum(arrays: tuple | list, seed: int) -> int:
    """Of the arrays' bytes and the seed: a file under another's name is not believed."""
    return zlib.crc32(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays), seed)
