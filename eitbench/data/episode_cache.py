"""Cached episodes: transfer resistances, noise and scoring integrals of all or the first steps.

With one vector and two integrals per step, scores do not need the mesh of the truth. Let P be the
interpolation from the estimators' nodes to the truth's, M the truth's mass matrix over the scored
region (the whole vessel, or `World.region`), and c and ĉ differences from the background. Then
    ∫(ĉ − c)² = ĉᵀ M̃ ĉ − 2 ĉᵀ b_t + d_t,      M̃ = Pᵀ M P,   b_t = Pᵀ M c_t,   d_t = c_tᵀ M c_t.
The second integral is ∫c_t² of the concentration itself, the denominator of the relative error.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from eitbench import _check
from eitbench.data import cache
from eitbench.data.episodes import (
    Episode,
    cache_per_truth,
    n_solutions,
    simulate,
    simulate_batch,
)
from eitbench.physics.profiles import VelocityModel
from eitbench.worlds.instrument import Faults, Instrument
from eitbench.worlds.random_streams import episode_streams
from eitbench.worlds.task import make_task
from eitbench.worlds.world import Vessel, World

if TYPE_CHECKING:
    from eitbench.numerics.mesh import Mesh  # finite elements: cached episodes do not need them

SCORING_VERSION = 1
"""Version of the cached scoring constants and region masses."""
EXTRA_STEPS = 12
"""Steps that are simulated after the first observation; environment checkers take ten."""
BUNDLED_SEED = 0
"""Seed of the episode whose prefix the package ships; a growing `EpisodeSampler` begins with it."""
CSR_ARRAYS = ("data", "indices", "indptr")
"""Attributes of a sparse matrix in CSR format."""


class ScoringConstants(NamedTuple):
    """Constants of a world that scores of all its episodes need."""

    mass: sp.csr_array
    """(n, n) upper triangle of M̃ over the whole vessel, m² (m³ in 3D), doubled off the diagonal:
    ĉᵀ·mass·ĉ = ĉᵀM̃ĉ."""
    largest_voltage: float
    """V, largest voltage of the injection cycle at the expected concentration."""


class ScoreIntegrals(NamedTuple):
    """Scoring integrals of an episode over the scored region, t = 1 … T."""

    moment: np.ndarray
    """(T, n) b_t, float32"""
    deviation: np.ndarray
    """(T,) ∫(c_t − background)²"""
    square: np.ndarray
    """(T,) ∫c_t²"""


# -- cached episodes --


def cached_episode(world: World, seed: int) -> np.ndarray:
    """Return an episode from the cache, or simulate and cache it.

    Returns
    -------
    (T,) structured array, read-only and memory-mapped, one entry for each t = 1 … T:

    ``transfer_resistance``  (L, L) 𝓡 in Ω (Ω·m in 2D)
    ``noise``                (L,) standard normal draws
    ``moment``               (n,) float32, b_t: scores are exact to 2e-10
    ``deviation``            ∫(c_t − background)²
    ``square``               ∫c_t²
    ``region_…``             moment, deviation, square over the world's region, if it has one
    ``velocity_moment``      (k,) ∫φ_k v_t across the pipe, if the task requests the flow
    ``velocity_square``      ∫v_t², if the task requests the flow
    """
    seed = _check.integer("seed", seed, low=0)

    def build() -> dict[str, np.ndarray]:
        return {"steps": build_cached_episode(world, simulate(world, seed))}

    return cache.cached(cache.episode_key(world, seed), build)["steps"]


def cached_episode_prefix(world: World, seed: int, needed: int) -> np.ndarray:
    """Return the entries of an episode's first steps, ``needed`` or more, shipped or simulated; of
    the whole episode if it is cached, or if the first steps take more than half of its time."""
    last = needed + EXTRA_STEPS
    is_short = 2 * n_solutions(world, last) > n_solutions(world, world.n_steps)
    if is_short or is_episode_cached(world, seed):
        return cached_episode(world, seed)
    entries = _shipped(world.truth_config) if seed == BUNDLED_SEED else None
    if entries is None or len(entries) < needed:
        entries = build_cached_episode(world, _prefix(world.truth_config, seed, last))
    return entries


def concentration_at(world: World, seed: int, t: int, needed: int) -> np.ndarray:
    """Return c_t (n_truth,) in mol/m³ on the truth's mesh; ``needed`` steps are simulated as in
    `cached_episode_prefix`."""
    last = needed + EXTRA_STEPS
    is_simulated = cache.episode_key(world, f"{seed}.truth").path.is_file()
    is_early = t <= last < world.n_steps and not is_simulated
    episode = _prefix(world.truth_config, seed, last) if is_early else simulate(world, seed)
    return episode.concentration[t].astype(float)


@lru_cache(maxsize=8)
def _prefix(config: World, seed: int, last: int) -> Episode:
    return next(simulate_batch(config, [seed], last=last))


def is_episode_cached(world: World, seed: int) -> bool:
    """Return whether the cache holds a valid file of the episode."""
    return cache.is_cached(cache.episode_key(world, seed))


def build_cached_episode(world: World, episode: Episode) -> np.ndarray:
    """Compute the entries of a cached episode from a simulated one or its prefix."""
    operators = {"": _score_operators(world.vessel, None)}
    if world.region is not None:
        operators["region_"] = score_operators(world)
    entries = np.zeros(len(episode.noise), step_dtype(world, operators[""][0].shape[1]))
    entries["transfer_resistance"] = episode.transfer_resistance
    entries["noise"] = episode.noise
    for prefix, over in operators.items():
        for name, array in integrate(episode, world.background, *over)._asdict().items():
            entries[prefix + name] = array
    velocity = world.velocity_model
    if velocity is not None:
        entries["velocity_moment"] = (episode.velocity * velocity.weights) @ velocity.profiles
        entries["velocity_square"] = episode.velocity**2 @ velocity.weights
    entries.setflags(write=False)
    return entries


def step_dtype(world: World, n_nodes: int) -> np.dtype:
    """Return the type of one step of a cached episode, for ``n_nodes`` of the estimators' mesh."""
    L = world.vessel.n_electrodes
    prefixes = ("",) if world.region is None else ("", "region_")
    scores = [(prefix + name, *layout) for prefix in prefixes for name, *layout in (
        ("moment", "<f4", (n_nodes,)), ("deviation", "<f8"), ("square", "<f8"))]
    velocity = world.velocity_model
    flow = [] if velocity is None else [
        ("velocity_moment", "<f8", (velocity.n_parameters,)), ("velocity_square", "<f8")]
    return np.dtype([("transfer_resistance", "<f8", (L, L)), ("noise", "<f8", (L,)),
                     *scores, *flow])


def prefix_file(world: World, needed: int = 0) -> cache.File:
    """Return the file of the shipped prefix: the upper triangles of the transfer resistances, which
    are symmetric, of the ``needed`` steps and `EXTRA_STEPS` more, without scored ones."""
    def build() -> dict[str, np.ndarray]:
        steps = min(needed + EXTRA_STEPS, world.warm_up)
        (episode,) = simulate_batch(world.truth_config, [BUNDLED_SEED], False, steps)
        upper = np.triu_indices(world.vessel.n_electrodes)
        return {"upper": episode.transfer_resistance[:, *upper]}

    key = cache.model_key("prefix", cache.config_dict(world.truth_config), cache.SIMULATION)
    return cache.File(key, build)


@cache_per_truth
def _shipped(world: World) -> np.ndarray | None:
    """Return the shipped steps as entries of a cached episode, None if the package has none; their
    integrals are placeholders, since these steps are not scored."""
    arrays = cache.load_shipped(prefix_file(world).key)
    if arrays is None:
        return None
    L = world.vessel.n_electrodes
    row, column = np.triu_indices(L)
    resistance = np.empty((len(arrays["upper"]), L, L))
    resistance[:, row, column] = resistance[:, column, row] = arrays["upper"]
    random = episode_streams(BUNDLED_SEED).noise
    noise = random.standard_normal((world.n_steps, L))
    entries = np.zeros(len(resistance), step_dtype(world, scoring_constants(world).mass.shape[0]))
    entries["transfer_resistance"] = resistance
    entries["noise"] = noise[:len(resistance)]
    for name in entries.dtype.names or ():
        if name.endswith("square"):
            entries[name] = 1.0  # relative errors divide by it
    entries.setflags(write=False)
    return entries


# -- voltages and scores --


def instrument_faults(world: World, seed: int) -> Faults:
    """Return the instrument faults of an episode."""
    random = episode_streams(seed).faults
    return world.instrument.draw(random, world.vessel.n_electrodes, world.n_steps)


def cycle_voltages(world: World, seed: int, entries: np.ndarray) -> np.ndarray:
    """Return the noisy voltages (T, L) in V of the world's injection cycle in an episode."""
    cycle = world.currents
    steps = np.arange(len(entries))
    return world.instrument.measure(instrument_faults(world, seed), steps + 1,
                                    entries["transfer_resistance"], cycle[steps % len(cycle)],
                                    entries["noise"])


def integrals(world: World, entries: np.ndarray) -> ScoreIntegrals:
    """Return the integrals of a cached episode over the scored region."""
    prefix = "" if world.region is None else "region_"
    return ScoreIntegrals(*(entries[f"{prefix}{name}"] for name in ScoreIntegrals._fields))


def integrate(episode: Episode, background: float, interpolation: sp.csr_array,
              mass: sp.csr_array) -> ScoreIntegrals:
    """Compute the integrals of an episode for ``interpolation`` P and ``mass`` M."""
    c = episode.concentration[1:].astype(float)
    deviation = c - background
    weighted = mass @ deviation.T
    return ScoreIntegrals((interpolation.T @ weighted).T.astype(np.float32),
                          np.einsum("tn,nt->t", deviation, weighted),
                          np.einsum("tn,nt->t", c, mass @ c.T))


def step_error(mass: sp.csr_array, estimate: np.ndarray, moment: np.ndarray,
               deviation: np.ndarray | float, square: np.ndarray | float) -> np.ndarray:
    """Return ∫(ĉ_t − c_t)² / ∫c_t² (...,); ``estimate`` (..., n) is ĉ_t minus the background."""
    # Contiguous: otherwise the summation order, and so the last bit, depends on the number of
    # estimates.
    quadratic = np.einsum("...n,...n->...", estimate, np.ascontiguousarray((mass @ estimate.T).T))
    return (quadratic - 2.0 * np.einsum("...n,...n->...", estimate, moment) + deviation) / square


def velocity_error(velocity: VelocityModel, parameters: np.ndarray, moment: np.ndarray,
                   square: np.ndarray | float) -> np.ndarray:
    """Return ∫(v̂_t − v_t)² / ∫v_t² across the pipe of ``parameters`` (..., k) in m/s."""
    quadratic = np.einsum("...k,kl,...l->...", parameters, velocity.gram, parameters)
    return (quadratic - 2.0 * np.einsum("...k,...k->...", parameters, moment) + square) / square


# -- constants of a world --


@cache_per_truth
def scoring_constants(world: World) -> ScoringConstants:
    """Return the scoring constants of a world, shipped, cached or computed."""
    arrays = cache.cached(*scoring_constants_file(world))
    return ScoringConstants(csr_of(arrays), float(arrays["largest"]))


def scoring_constants_file(world: World) -> cache.File:
    """Return the file of scoring constants; they depend on vessel, prior, current and pattern."""
    def build() -> dict[str, np.ndarray]:
        task = make_task(world.truth_config)
        homogeneous = np.full(task.mesh.n_nodes, world.expected_concentration)
        largest = np.abs(task.observation.voltages(homogeneous, world.truth_config.currents)).max()
        mass = _half_mass(*_score_operators(world.vessel, None))
        return mass | {"largest": np.array(largest)}

    instrument = Instrument(current=world.instrument.current)
    config = cache.config_dict(replace(world.truth_config, instrument=instrument))
    parts = {name: config[name] for name in ("vessel", "instrument", "prior")}
    parts["pattern"] = config["schedule"]["pattern"]
    return cache.File(cache.model_key("outline", parts, SCORING_VERSION), build)


@cache_per_truth
def score_mass(world: World) -> sp.csr_array:
    """Return M̃ (n, n) over the scored region, in the form of `ScoringConstants.mass`."""
    if world.region is None:
        return scoring_constants(world).mass
    return csr_of(cache.cached(*region_file(world)))


def region_file(world: World) -> cache.File:
    """Return the file of the mass matrix of a world's region."""
    configuration = [cache.config_dict(world.vessel), world.region]
    key = cache.model_key("region", configuration, SCORING_VERSION)
    return cache.File(key, lambda: _half_mass(*score_operators(world)))


def truth_mesh(world: World) -> Mesh:
    """Return the mesh of the ground truth."""
    return _truth_mesh(world.vessel)


@lru_cache(maxsize=4)
def _truth_mesh(vessel: Vessel) -> Mesh:
    return vessel.transport_mesh(fine=True)[0]


def score_operators(world: World) -> tuple[sp.csr_array, sp.csr_array]:
    """Return P and M over the scored region."""
    return _score_operators(world.vessel, world.region)


@lru_cache(maxsize=8)
def _score_operators(vessel: Any, region: tuple[float, float] | None,
                     ) -> tuple[sp.csr_array, sp.csr_array]:
    from eitbench.numerics.fem import mass_matrix
    truth = _truth_mesh(vessel)
    if region is not None:
        return _score_operators(vessel, None)[0], mass_between(truth, *region)
    model = vessel.transport_mesh(fine=False)[0]
    return model.interpolation_to(truth.points), mass_matrix(truth)


def mass_between(mesh: Mesh, begin: float, end: float) -> sp.csr_array:
    """Return the P1 mass matrix (n, n), m² (m³ in 3D), of cells with centroids in (begin, end)."""
    centroids = mesh.points[mesh.cells][:, :, 0].mean(axis=1)
    inside = (begin < centroids) & (centroids < end)
    cells = mesh.cells[inside]
    corners = mesh.dim + 1
    local = mesh.volumes[inside, None, None] * (1.0 + np.eye(corners)) / (corners * (corners + 1))
    rows = np.repeat(cells, corners, axis=1).ravel()
    columns = np.tile(cells, corners).ravel()
    return sp.csr_array((local.ravel(), (rows, columns)), shape=(mesh.n_nodes,) * 2)


def _half_mass(interpolation: sp.csr_array, mass: sp.csr_array) -> dict[str, np.ndarray]:
    """Return the upper triangle of M̃, doubled off the diagonal, as `CSR_ARRAYS` arrays."""
    full = interpolation.T @ mass @ interpolation
    half = sp.csr_array(sp.triu(full) + sp.triu(full, 1))
    return {name: getattr(half, name) for name in CSR_ARRAYS}


def csr_of(arrays: Mapping[str, np.ndarray]) -> sp.csr_array:
    """Return the square matrix of `CSR_ARRAYS` arrays."""
    data, indices, indptr = (arrays[name] for name in CSR_ARRAYS)
    return sp.csr_array((data, indices, indptr), shape=(len(indptr) - 1,) * 2)
