"""Episodes as examples to learn from: what was measured, and what was there.

The truth is given on the estimators' nodes, as the concentration p_t that is nearest to it in the
norm of the score. With M̃ and b_t as in `eitbench.data.recordings`, M̃ p_t = b_t and
    ∫(ĉ − c_t)² = (ĉ − p_t)ᵀ M̃ (ĉ − p_t) + ∫(p_t − c_t)²
for every ĉ on these nodes: scores need no mesh of the truth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from eitbench import _check
from eitbench._extras import needed_by
from eitbench.data.bank import TOGETHER, fill_here
from eitbench.data.episodes import once
from eitbench.data.recordings import cycle_voltages, outline, recording
from eitbench.data.regions import integrals, score_mass
from eitbench.data.seeds import is_test, name_seed, parse_seeds
from eitbench.worlds.registry import entry
from eitbench.worlds.world import World

if TYPE_CHECKING:
    import scipy.sparse as sp

    from eitbench.data.learning.reduced import ReducedDataset
    from eitbench.data.learning.torch_dataset import TorchDataset
    from eitbench.numerics.mesh import Mesh
    from eitbench.physics.profiles import VelocityModel


TOUCHED = 1e-9
"""A node with a smaller part of the largest mass is not in a region but on its edge, by rounding:
what is projected there could be anything."""


class Example(NamedTuple):
    """An episode, t = 1 … T: L readings and n nodes of the estimators' mesh at each t."""

    seed: int
    """see `eitbench.data.seeds`"""
    voltages: np.ndarray
    """(T, L) V, measured under the world's injection cycle"""
    currents: np.ndarray
    """(T, L) A (A/m in 2D), injected"""
    truth: np.ndarray
    """(T, n) float32 mol/m³, the true concentration's projection p_t"""
    unresolved: np.ndarray
    """(T,) ∫(p_t − c_t)² in (mol/m³)²·m² (m³ in 3D): what no estimate can do without"""
    square: np.ndarray
    """(T,) ∫c_t² in the same unit"""
    velocity: np.ndarray
    """(T, k) m/s, the flow's parameters that fit the true flow best; k = 0 where nobody asks"""


class Surrogate(Protocol):
    """What makes examples without a simulation, such as `eitbench.estimation.Surrogate`."""

    def example(self, seed: int) -> Example:
        """The example of one episode."""

    @property
    def source(self) -> Mapping[str, Any]:
        """What it is made of, fit for JSON."""


@dataclass(frozen=True)
class Dataset:
    """Examples of a world, in the order of their seeds; `dataset` makes it.

    Iterating holds one example at a time. What was never simulated is, eight episodes together, and
    kept in the cache; `eitbench bank` does so beforehand, in several processes.
    """

    env: str
    """the environment's id"""
    world: World
    seeds: tuple[int, ...]
    surrogate: Surrogate | None = None
    """what makes them in place of the simulation; see `eitbench.surrogate_dataset`"""

    def __len__(self) -> int:
        return len(self.seeds)

    def __iter__(self) -> Iterator[Example]:
        for k in range(0, len(self.seeds), TOGETHER):
            group = self.seeds[k:k + TOGETHER]
            if self.surrogate is None:
                fill_here(self.world, group)
            for seed in group:
                yield self.example(seed)

    def __getitem__(self, index: int) -> Example:
        return self.example(self.seeds[index])

    def example(self, seed: int) -> Example:
        """That of one of the seeds."""
        return example(self.world, seed) if self.surrogate is None else self.surrogate.example(seed)

    @property
    def mesh(self) -> Mesh:
        """On whose nodes `Example.truth` is."""
        return self.world.vessel.carrier(fine=False)[0]  # type: ignore[no-any-return]

    @property
    def mass(self) -> sp.csr_array:
        """(n, n) M̃ in m² (m³ in 3D): ∫f² = fᵀ M̃ f of nodal values f, over what counts."""
        return _symmetric(score_mass(self.world))

    @property
    def warm_up(self) -> int:
        """So many first states are not scored."""
        return self.world.warm_up

    def errors(self, example: Example, estimate: np.ndarray) -> np.ndarray:
        """(T,) ∫(ĉ_t − c_t)²/∫c_t² of an ``estimate`` (T, n) in mol/m³; ẽ_c (thesis 5.12) is the
        mean over t > warm_up, as the environment scores it."""
        estimate = _check.array("estimate", estimate, example.truth.shape, units="mol/m³")
        off = estimate - example.truth
        return (np.einsum("tn,nt->t", off, self.mass @ off.T) + example.unresolved) / example.square

    def modes(self, q: int) -> np.ndarray:
        """(n, q) the strongest modes of what these examples' true states, from the first that is
        scored on, are off the world's background: the best basis for them in the norm of the
        score, and orthonormal in it. ``ValueError`` if there are fewer than q."""
        from eitbench.data.learning.reduced import strongest
        return strongest(self, q)[0]

    def reduced(self, basis: np.ndarray,
                mean: float | np.ndarray | None = None) -> ReducedDataset:
        """The same examples in coordinates a, c = mean + basis a, in which scores are exact too.

        Parameters
        ----------
        basis : (n, q) array, mol/m³
            Such as `modes`. ``ValueError`` if its columns depend on each other.
        mean : float or (n,) array, mol/m³
            Default: the world's background.
        """
        from eitbench.data.learning.reduced import ReducedDataset
        return ReducedDataset(self, basis, self.world.background if mean is None else mean)

    def torch(self) -> TorchDataset:
        """The same as a dataset for torch. ``ModuleNotFoundError`` if torch is not installed."""
        return as_torch(self)


def as_torch(examples: Dataset | ReducedDataset) -> TorchDataset:
    """As `Dataset.torch`."""
    with needed_by("a dataset for torch"):
        from eitbench.data.learning.torch_dataset import TorchDataset
    return TorchDataset(examples)


def dataset(env: str, seeds: str | Sequence[int], *,
            world: Mapping[str, Any] | None = None) -> Dataset:
    """Episodes of an environment as examples to learn from.

    Parameters
    ----------
    env : str
        A registered id. Of an injection environment, the voltages of its world's own cycle.
    seeds : str or sequence of int
        As in ``"train:0-199"``, or the seeds themselves. Test episodes, on which methods are
        scored, are given only if their split is named: ``"test:0-9"``.
    world : dict, optional
        Numbers of the world's parts to change; see `World.changed`.

    Raises
    ------
    ValueError
        If there is no such environment, number or seed, or a test episode is not asked for by name.
    """
    return Dataset(env, entry(env).world.changed(world), asked_seeds(seeds))


def asked_seeds(seeds: str | Sequence[int]) -> tuple[int, ...]:
    """Each once; ``ValueError`` if there is none, or a test episode is not asked for by name."""
    numbers = parse_seeds(seeds) if isinstance(seeds, str) else [
        _check.integer("seeds", seed, low=0) for seed in seeds]
    if not numbers:
        raise ValueError(f"seeds must name at least one episode, got {seeds!r}")
    named = isinstance(seeds, str) and ":" in seeds
    if not named and (tests := [seed for seed in numbers if is_test(seed)]):
        raise ValueError("seeds must name the split of test episodes, on which methods are scored: "
                         f"'{name_seed(tests[0])}', got {tests[0]}")
    return tuple(dict.fromkeys(numbers))


def example(world: World, seed: int) -> Example:
    """The example of one episode, from the cache if it is there; else it is simulated."""
    entries = recording(world, seed)
    truth, unresolved, square = _projected(world, seed, entries)
    velocity = world.velocity_model
    flow = np.empty((len(entries), 0))
    if velocity is not None:
        flow = fitted(velocity, entries["velocity_moment"])
    return Example(seed, cycle_voltages(world, seed, entries), cycle_currents(world),
                   (world.background + truth).astype(np.float32), unresolved, square, flow)


def cycle_currents(world: World) -> np.ndarray:
    """(T, L) A (A/m in 2D), injected at t = 1 … T."""
    cycle = world.currents
    return cycle[np.arange(world.n_steps) % len(cycle)]


def fitted(velocity: VelocityModel, moment: np.ndarray) -> np.ndarray:
    """(T, k) m/s: the parameters whose flow has these ``moment`` (T, k) ∫φ_k v_t."""
    gram = velocity.profiles.T @ (velocity.weights[:, None] * velocity.profiles)
    return np.linalg.solve(gram, moment.T).T


def _projected(world: World, seed: int,
               entries: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """p_t less the background (T, n), ∫(p_t − c_t)² and ∫c_t² (T,).

    Of a world with a region the integrals are over the region, and p_t is the projection there;
    nodes beyond it have that of the whole vessel.
    """
    truth = _solver(world)(entries["moment"].astype(float).T).T
    counted = integrals(world, seed, entries)
    moment = counted.moment.astype(float)
    if world.region is not None:
        inside, solve = _region_solver(world)
        truth[:, inside] = solve(moment[:, inside].T).T
    unresolved = counted.deviation - np.einsum("tn,tn->t", moment, truth)
    return truth, unresolved, np.array(counted.square)


Solver = Callable[[np.ndarray], np.ndarray]


@once(4)
def _solver(world: World) -> Solver:
    """b (n, T) -> M̃⁻¹ b over the whole vessel."""
    return _factorised(_symmetric(outline(world).mass))


@once(4)
def _region_solver(world: World) -> tuple[np.ndarray, Solver]:
    """The nodes that the world's region touches, and M̃⁻¹ of them."""
    mass = _symmetric(score_mass(world))
    diagonal = mass.diagonal()
    inside = np.flatnonzero(diagonal > TOUCHED * diagonal.max())
    return inside, _factorised(mass[inside][:, inside])


def _factorised(mass: sp.csr_array) -> Solver:
    from scipy.sparse.linalg import splu
    solver: Solver = splu(mass.tocsc()).solve
    return solver


def _symmetric(half: sp.csr_array) -> sp.csr_array:
    """M̃ from its triangle with doubled entries."""
    return (0.5 * (half + half.T)).tocsr()
