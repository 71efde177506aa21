"""The mass matrices that scores are computed with, over the whole vessel or a region of interest.

With P the interpolation from the estimators' nodes to those of the simulated truth, M the truth's
mass matrix over what counts, and all concentrations relative to the world's background,
    ∫(ĉ − c)² = ĉᵀ M̃ ĉ − 2 ĉᵀ b_t + d_t,      M̃ = Pᵀ M P,   b_t = Pᵀ M c_t,   d_t = c_tᵀ M c_t.
A world with a ``region`` counts errors between two cross-sections only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from eitbench.data.cache import Key, cached, described, model_key
from eitbench.data.episodes import Episode, once, truth_discretisation
from eitbench.worlds.instrument import Instrument
from eitbench.worlds.task import make_task

if TYPE_CHECKING:
    import scipy.sparse as sp

    from eitbench.numerics.mesh import Mesh
    from eitbench.worlds.world import World

VERSION = 1
"""Version of the outlines and region masses that are kept."""
SPARSE = ("data", "indices", "indptr")
"""Arrays that hold a sparse matrix."""


class Outline(NamedTuple):
    """The scoring constants that all episodes of a world share."""

    mass: sp.csr_array
    """(n, n) upper triangle of M̃ over the whole vessel, m² (m³ in 3D), doubled off the diagonal:
    ĉᵀ·mass·ĉ = ĉᵀM̃ĉ."""
    largest_voltage: float
    """V, of the cycle's injections into liquid of the expected concentration."""


class Integrals(NamedTuple):
    """The integrals that score an episode, t = 1 … T, over what counts."""

    moment: np.ndarray
    """(T, n) float32, b_t"""
    deviation: np.ndarray
    """(T,) ∫(c_t − background)²"""
    square: np.ndarray
    """(T,) ∫c_t²"""


def integrals(world: World, seed: int, entries: np.ndarray) -> Integrals:
    """Return the integrals of an episode's recording ``entries`` over what counts."""
    prefix = "" if world.region is None else "region_"
    return Integrals(*(entries[f"{prefix}{name}"] for name in Integrals._fields))


def make_integrals(world: World, episode: Episode) -> Integrals:
    """Compute the integrals of an episode over what counts."""
    return integrate(episode, world.background, *region_operators(world))


def integrate(episode: Episode, background: float, interpolation: sp.csr_array,
              mass: sp.csr_array) -> Integrals:
    """Compute the integrals of an episode for these P and M."""
    c = episode.concentration[1:].astype(float)
    deviation = c - background
    weighted = mass @ deviation.T
    return Integrals((interpolation.T @ weighted).T.astype(np.float32),
                     np.einsum("tn,nt->t", deviation, weighted),
                     np.einsum("tn,nt->t", c, mass @ c.T))


def outline(world: World) -> Outline:
    """Return the outline of a world, shipped, cached or computed."""
    return _outline(world.fluid)


@lru_cache(maxsize=4)
def _outline(fluid: World) -> Outline:
    arrays = cached(outline_key(fluid), lambda: make_outline(fluid))
    return Outline(csr_of(arrays), float(arrays["largest"]))


def outline_key(world: World) -> Key:
    """Return the key of a world's outline, which neither flow, target nor contacts change."""
    instrument = Instrument(current=world.instrument.current)
    fluid = described(replace(world.fluid, instrument=instrument))
    numbers = {name: fluid[name] for name in ("vessel", "instrument", "prior")}
    return model_key("outline", numbers | {"pattern": fluid["schedule"]["pattern"]}, VERSION)


def make_outline(world: World) -> dict[str, np.ndarray]:
    """Compute the arrays of a world's outline."""
    task = make_task(world.fluid)
    level = np.full(task.mesh.n_nodes, world.expected_concentration)
    largest = np.abs(task.observation.voltages(level, world.fluid.currents)).max()
    return half_mass(*score_operators(world)) | {"largest": np.array(largest)}


@once(4)
def score_mass(world: World) -> sp.csr_array:
    """Return M̃ (n, n) of what counts, one triangle with doubled entries as `Outline.mass`."""
    if world.region is None:
        return outline(world).mass
    return csr_of(cached(region_key(world), lambda: make_region(world)))


def region_key(world: World) -> Key:
    """Return the key of the mass matrix of a world's region."""
    return model_key("region", [described(world.vessel), world.region], VERSION)


def make_region(world: World) -> dict[str, np.ndarray]:
    """Compute the arrays of the mass matrix of a world's region."""
    return half_mass(*region_operators(world))


@once(2)
def score_operators(world: World) -> tuple[sp.csr_array, sp.csr_array]:
    """Return P and M over the whole vessel."""
    from eitbench.numerics.fem import mass_matrix
    truth = truth_discretisation(world).transport.mesh
    return world.vessel.carrier(fine=False)[0].interpolation_to(truth.points), mass_matrix(truth)


@once(2)
def region_operators(world: World) -> tuple[sp.csr_array, sp.csr_array]:
    """Return P and M over what counts."""
    interpolation, mass = score_operators(world)
    if world.region is not None:
        mass = mass_between(truth_discretisation(world).transport.mesh, *world.region)
    return interpolation, mass


def mass_between(mesh: Mesh, begin: float, end: float) -> sp.csr_array:
    """Return the P1 mass matrix (n, n) in m² (m³ in 3D) of the cells with centroids in
    begin < x < end (m)."""
    import scipy.sparse as sp
    middle = mesh.points[mesh.cells][:, :, 0].mean(axis=1)
    inside = (begin < middle) & (middle < end)
    cells = mesh.cells[inside]
    corners = mesh.dim + 1
    local = mesh.volumes[inside, None, None] * (1.0 + np.eye(corners)) / (corners * (corners + 1))
    rows = np.repeat(cells, corners, axis=1).ravel()
    columns = np.tile(cells, corners).ravel()
    return sp.csr_array((local.ravel(), (rows, columns)), shape=(mesh.n_nodes,) * 2)


def half_mass(interpolation: sp.csr_array, mass: sp.csr_array) -> dict[str, np.ndarray]:
    """Return M̃'s upper triangle with doubled entries off the diagonal as `SPARSE` arrays."""
    import scipy.sparse as sp
    full = interpolation.T @ mass @ interpolation
    half = sp.csr_array(sp.triu(full) + sp.triu(full, 1))
    return {name: getattr(half, name) for name in SPARSE}


def csr_of(arrays: Mapping[str, np.ndarray]) -> sp.csr_array:
    """Return the square matrix of `SPARSE` arrays."""
    import scipy.sparse as sp
    data, indices, indptr = (arrays[name] for name in SPARSE)
    return sp.csr_array((data, indices, indptr), shape=(len(indptr) - 1,) * 2)
