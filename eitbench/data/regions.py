"""Scores of a part of the vessel: what recordings hold of the whole, restricted to a world's region
of interest.

A world with a ``region`` counts errors between two cross-sections only. The integrals of
`eitbench.data.recordings` are then taken over the cells of the truth's mesh that lie between them,
and kept in a file beside the recording. Without a region they are the recording's own.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from eitbench.data import store
from eitbench.data.episodes import Episode, simulate, truth_discretisation
from eitbench.data.recordings import SPARSE, doubled_triangle, outline, score_operators, sparse_of

if TYPE_CHECKING:
    import scipy.sparse as sp

    from eitbench.numerics.mesh import Mesh
    from eitbench.worlds.world import World


class Integrals(NamedTuple):
    """What an episode is scored by, t = 1 … T, over what counts; see `eitbench.data.recordings`."""

    moment: np.ndarray
    """(T, n) float32, b_t"""
    deviation: np.ndarray
    """(T,) ∫(c_t − background)²"""
    square: np.ndarray
    """(T,) ∫c_t²"""


def integrals(world: World, seed: int, entries: np.ndarray) -> Integrals:
    """What the episode of this seed, whose recording is ``entries``, is scored by. Over a region it
    is from the cache if it is there; else it is simulated."""
    if world.region is None:
        return Integrals(entries["moment"], entries["deviation"], entries["square"])

    def make() -> dict[str, Any]:
        return make_integrals(world, simulate(world, seed))._asdict()

    return Integrals(**store.kept(integrals_path(world, seed), Integrals._fields, make, str(seed)))


def integrals_path(world: World, seed: int) -> Path:
    """Where the integrals over a world's region are kept."""
    return store.folder(world) / f"{seed}.region.npz"


def are_kept(world: World, seed: int) -> bool:
    """Whether the file of the region, if the world has one, is there and sound."""
    return world.region is None or store.load(integrals_path(world, seed), Integrals._fields, str(seed)) is not None


def make_integrals(world: World, episode: Episode) -> Integrals:
    """The integrals over the world's region; ``episode`` is its truth."""
    interpolation, mass = region_operators(world)
    c = episode.concentration[1:].astype(float)
    deviation = c - world.background
    weighted = mass @ deviation.T
    return Integrals((interpolation.T @ weighted).T.astype(np.float32), np.einsum("tn,nt->t", deviation, weighted),
                     np.einsum("tn,nt->t", c, mass @ c.T))


def store_integrals(path: Path, seed: int, made: Integrals) -> None:
    """Write the integrals of an episode where `integrals` finds them."""
    store.save(path, made._asdict(), str(seed))


def score_mass(world: World) -> sp.csr_array:
    """(n, n) M̃ of what counts, its upper triangle with the entries beside the diagonal doubled, as
    `Outline.mass`."""
    return outline(world).mass if world.region is None else _region_mass(world.fluid)


@lru_cache(maxsize=4)
def _region_mass(fluid: World) -> sp.csr_array:
    def make() -> dict[str, np.ndarray]:
        interpolation, mass = region_operators(fluid)
        half = doubled_triangle(interpolation.T @ mass @ interpolation)
        return {name: getattr(half, name) for name in SPARSE}

    return sparse_of(store.kept(store.folder(fluid) / "region.npz", SPARSE, make))


def region_operators(world: World) -> tuple[sp.csr_array, sp.csr_array]:
    """(interpolation from the model's CD mesh to the truth's, the truth's mass matrix over the
    region)."""
    interpolation, mass = score_operators(world)
    return interpolation, mass if world.region is None else _mass_of_region(world.fluid)


@lru_cache(maxsize=2)
def _mass_of_region(fluid: World) -> sp.csr_array:
    assert fluid.region is not None
    return mass_between(truth_discretisation(fluid).transport.mesh, *fluid.region)


def mass_between(mesh: Mesh, begin: float, end: float) -> sp.csr_array:
    """(n, n) P1 mass matrix ∫φᵢφⱼ in m² (m³ in 3D) over the cells whose centroids lie in begin < x
    < end (m)."""
    import scipy.sparse as sp
    middle = mesh.points[mesh.cells][:, :, 0].mean(axis=1)
    inside = (begin < middle) & (middle < end)
    cells = mesh.cells[inside]
    corners = mesh.dim + 1
    local = mesh.volumes[inside, None, None] * (1.0 + np.eye(corners)) / (corners * (corners + 1))
    rows = np.repeat(cells, corners, axis=1).ravel()
    columns = np.tile(cells, corners).ravel()
    return sp.csr_array((local.ravel(), (rows, columns)), shape=(mesh.n_nodes,) * 2)
