"""Data sets for machine learning: measurements and true concentrations of episodes.

The target is the projection p_t of the truth onto the estimators' nodes in the norm of the score.
With M̃ and b_t of `eitbench.data.episode_cache`, M̃ p_t = b_t, and for every ĉ on these nodes
    ∫(ĉ − c_t)² = (ĉ − p_t)ᵀ M̃ (ĉ − p_t) + ∫(p_t − c_t)².
In reduced coordinates, with ĉ = c̄ + B â, G = Bᵀ M̃ B and the projection a_t,
    ∫(c̄ + B â − c_t)² = (â − a_t)ᵀ G (â − a_t) + ∫(c̄ + B a_t − c_t)².
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu
from tqdm import tqdm

from eitbench import _check
from eitbench.data.episode_cache import (
    cached_episode,
    cycle_voltages,
    integrals,
    score_mass,
)
from eitbench.data.episodes import cache_per_truth
from eitbench.data.presimulation import BATCH_SIZE, presimulate
from eitbench.data.seeds import format_seed, is_test, parse_seeds
from eitbench.worlds.registry import entry
from eitbench.worlds.world import World

if TYPE_CHECKING:
    from eitbench.numerics.mesh import Mesh  # finite elements: examples do not need them

MIN_MASS = 1e-9
"""Diagonal mass relative to the largest, below which a node is outside the region."""
SNAPSHOT_STRIDE = 2
"""Steps between snapshots for POD modes."""
RANK_TOLERANCE = 1e-12
"""Squared singular value relative to the largest, below which directions are dependent."""


class Example(NamedTuple):
    """Measurements and truth of an episode, t = 1 … T, with L electrodes and n nodes."""

    seed: int
    """see `eitbench.data.seeds`"""
    voltages: np.ndarray
    """(T, L) V, measured with the world's injection cycle"""
    currents: np.ndarray
    """(T, L) A (A/m in 2D), injected"""
    truth: np.ndarray
    """(T, n) float32 mol/m³, projection p_t of the true concentration, or its coordinates (T, q)"""
    unresolved: np.ndarray
    """(T,) ∫(p_t − c_t)² in (mol/m³)²·m² (m³ in 3D): the error of the best estimate"""
    square: np.ndarray
    """(T,) ∫c_t² in the same unit"""
    velocity: np.ndarray
    """(T, k) m/s, parameters of the best fit to the true flow; k = 0 if the flow is specified"""


@dataclass(frozen=True, eq=False)
class Dataset:
    """Examples of a world in the order of their seeds; see `dataset`.

    Iteration loads one example at a time. Missing episodes are simulated in batches of eight and
    cached; `eitbench bank` simulates them in advance, in several processes. ``DataLoader`` of torch
    accepts it as a map-style data set.
    """

    env: str
    """id of the environment"""
    world: World
    seeds: tuple[int, ...]
    basis: np.ndarray | None = None
    """(n, q) B in mol/m³ of reduced coordinates; None: nodal values"""
    mean: float | np.ndarray = 0.0
    """c̄ in mol/m³, a number or (n,)"""

    def __len__(self) -> int:
        return len(self.seeds)

    def __iter__(self) -> Iterator[Example]:
        for k in range(0, len(self.seeds), BATCH_SIZE):
            group = self.seeds[k:k + BATCH_SIZE]
            presimulate(self.world, group, show_steps=True)
            yield from map(self.example, group)

    def __getitem__(self, index: int) -> Example:
        return self.example(self.seeds[index])

    def example(self, seed: int) -> Example:
        """Return the example of one episode, simulated if it is not cached."""
        world = self.world
        entries = cached_episode(world, seed)
        cycle = world.currents
        velocity = world.velocity_model
        flow = np.empty((len(entries), 0)) if velocity is None else (
            np.linalg.solve(velocity.gram, entries["velocity_moment"].T).T)
        nodal = Example(seed, cycle_voltages(world, seed, entries),
                        cycle[np.arange(world.n_steps) % len(cycle)], *_projected(world, entries),
                        flow)
        return nodal if self.basis is None else self.project_example(nodal)

    def project_example(self, example: Example) -> Example:
        """Return an example with nodal values in these coordinates."""
        deviation = example.truth.astype(float) - self.mean
        a = np.linalg.solve(self.mass, self._weighted.T @ deviation.T).T
        residual = deviation - a @ self._columns.T
        square = np.einsum("tn,nt->t", residual, self._nodal_mass @ residual.T)
        return example._replace(truth=a, unresolved=example.unresolved + square)

    @property
    def mesh(self) -> Mesh:
        """Mesh of the nodes."""
        return self.world.vessel.transport_mesh(fine=False)[0]  # type: ignore[no-any-return]

    @property
    def warm_up(self) -> int:
        """Number of first states that are not scored."""
        return self.world.warm_up

    @cached_property
    def mass(self) -> Any:
        """Sparse M̃ (n, n) in m² (m³ in 3D), ∫f² = fᵀ M̃ f over the scored region for nodal values
        f, or G (q, q) in (mol/m³)²·m², the identity for `pod_modes`."""
        if self.basis is None:
            return self._nodal_mass
        gram = self._columns.T @ self._weighted
        return 0.5 * (gram + gram.T)

    def errors(self, example: Example, estimate: np.ndarray) -> np.ndarray:
        """Return ∫(ĉ_t − c_t)²/∫c_t² (T,) of an ``estimate`` of the shape of `Example.truth`.

        The score ẽ_c (thesis 5.12) is the mean over t > warm_up.
        """
        estimate = _check.array("estimate", estimate, example.truth.shape)
        error = estimate - example.truth
        projected = np.einsum("tn,nt->t", error, self.mass @ error.T)
        return (projected + example.unresolved) / example.square

    def pod_modes(self, q: int) -> np.ndarray:
        """Return the POD basis (n, q) of the scored states relative to the background, optimal and
        orthonormal in the norm of the score. ``ValueError`` if the states have fewer modes."""
        return pod_basis(self, q)[0]

    def project(self, basis: np.ndarray, mean: float | np.ndarray | None = None) -> Dataset:
        """Return the same examples in coordinates a, c = mean + basis a, with exact scores.

        ``basis`` (n, q) in mol/m³, such as `pod_modes`, must have linearly independent columns;
        otherwise ``ValueError``. ``mean`` is a number or (n,) in mol/m³, by default the background.
        """
        n = self.mesh.n_nodes
        basis = _check.array("basis", basis, (n, None), units="mol/m³")
        if mean is None:
            mean = self.world.background
        else:
            mean = _check.array("mean", mean, (n,) if np.ndim(mean) else (), units="mol/m³")
        reduced = Dataset(self.env, self.world, self.seeds, basis, mean)
        squares = np.linalg.eigvalsh(reduced.mass)
        if not squares[0] > RANK_TOLERANCE * squares[-1]:
            raise ValueError("basis must have independent columns over the scored region; some of "
                             f"these {len(squares)} depend on others")
        return reduced

    def concentration(self, coordinates: np.ndarray) -> np.ndarray:
        """Return mol/m³ (..., n) of coordinates (..., q)."""
        found: np.ndarray = self.mean + coordinates @ self._columns.T
        return found

    @cached_property
    def _nodal_mass(self) -> sp.csr_array:
        return _symmetric(score_mass(self.world))

    @property
    def _columns(self) -> np.ndarray:
        if self.basis is None:
            raise ValueError("the dataset must have a basis, see Dataset.project; got None")
        return self.basis

    @cached_property
    def _weighted(self) -> np.ndarray:
        return np.asarray(self._nodal_mass @ self._columns)


def dataset(env: str, seeds: str | Sequence[int], *,
            world: Mapping[str, Any] | None = None) -> Dataset:
    """Return episodes of a registered environment as training examples; an injection environment
    uses the injection cycle of its world.

    ``seeds`` are integers, or a text such as ``"train:0-199"``. Test episodes, on which methods are
    scored, require the name of their split: ``"test:0-9"``. ``world`` changes parts of the world,
    see `World.with_changes`. ``ValueError`` for an unknown environment, number or seed, or a test
    episode without its split.
    """
    return Dataset(env, entry(env).world.with_changes(world), resolve_seeds(seeds))


def resolve_seeds(seeds: str | Sequence[int]) -> tuple[int, ...]:
    """Return the seeds without duplicates; ``ValueError`` for none or an unnamed test split."""
    numbers = parse_seeds(seeds) if isinstance(seeds, str) else [
        _check.integer("seeds", seed, low=0) for seed in seeds]
    if not numbers:
        raise ValueError(f"seeds must name at least one episode, got {seeds!r}")
    named = isinstance(seeds, str) and ":" in seeds
    if not named and (tests := [seed for seed in numbers if is_test(seed)]):
        raise ValueError("seeds must name the split of test episodes, on which methods are scored: "
                         f"'{format_seed(tests[0])}', got {tests[0]}")
    return tuple(dict.fromkeys(numbers))


def pod_basis(examples: Dataset, q: int) -> tuple[np.ndarray, np.ndarray]:
    """Return `Dataset.pod_modes`, and the mean square (n,) of the projection error in (mol/m³)²."""
    n = examples.mesh.n_nodes
    q = _check.integer("q", q, low=1, high=n)
    second = np.zeros((n, n))
    states = 0
    for example in tqdm(examples, desc="modes", unit="episode", disable=None):
        truth = example.truth[examples.warm_up::SNAPSHOT_STRIDE].astype(float)
        deviation = truth - examples.world.background
        second += deviation.T @ deviation
        states += len(deviation)
    second /= states
    # R Rᵀ = second; modes are R v/√λ with eigenvectors v of Rᵀ M̃ R, because M̃ may be singular
    values, vectors = np.linalg.eigh(second)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    values, vectors = np.linalg.eigh(root.T @ (examples.mass @ root))
    rank = int((values > RANK_TOLERANCE * values[-1]).sum())
    if q > rank:
        raise ValueError(f"q must be at most {rank}, the number of modes of these states; got {q}")
    last = slice(None, -q - 1, -1)
    basis = root @ vectors[:, last] / np.sqrt(values[last])
    residual = second.diagonal() - basis**2 @ values[last]
    return basis, np.maximum(residual, 0.0)


def _projected(world: World, entries: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return p_t (T, n) in mol/m³, ∫(p_t − c_t)² and ∫c_t² (T,) over the scored region.

    Nodes outside a region have the projection over the whole vessel.
    """
    truth = np.zeros(entries["moment"].shape)
    for each in dict.fromkeys((replace(world, region=None), world)):
        scored = integrals(each, entries)
        moment = scored.moment.astype(float)
        inside, solve = _solver(each)
        truth[:, inside] = solve(moment[:, inside].T).T
    unresolved = scored.deviation - np.einsum("tn,tn->t", moment, truth)
    return (world.background + truth).astype(np.float32), unresolved, np.array(scored.square)


@cache_per_truth
def _solver(world: World) -> tuple[np.ndarray, Any]:
    """Return the nodes of the world's region, and a solver with M̃ restricted to them."""
    mass = _symmetric(score_mass(world))
    diagonal = mass.diagonal()
    inside = np.flatnonzero(diagonal > MIN_MASS * diagonal.max())
    return inside, splu(mass[inside][:, inside].tocsc()).solve


def _symmetric(half: sp.csr_array) -> sp.csr_array:
    """Return M̃ from its upper triangle, which is doubled off the diagonal."""
    return (0.5 * (half + half.T)).tocsr()
