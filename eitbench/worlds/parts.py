"""The parts of a world: what vessel, flow and target can be asked, and what is believed before."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from eitbench import _check
from eitbench.physics.observation import ObservationModel

if TYPE_CHECKING:
    from eitbench.numerics.mesh import Mesh
    from eitbench.physics.cem import CompleteElectrodeModel
    from eitbench.physics.profiles import SkewedChannelFlow, VelocityModel
    from eitbench.physics.transport import Transport, VelocityField
    from eitbench.worlds.streams import Randomness
    from eitbench.worlds.world import World


LATER = {"later": True}
"""Metadata of a number that a part was given later: at its default it is left out of the names
under which things are kept, so that what was kept before it came is still found."""


class Discretisation(NamedTuple):
    """A world on meshes: how the concentration moves and how it is seen."""

    transport: Transport
    observation: ObservationModel


class History(NamedTuple):
    """What moved in one episode."""

    concentration: np.ndarray
    """(T + 1, n) mol/m³ at the nodes of the truth's CD mesh, t = 0 … T"""
    velocity: np.ndarray
    """(T, p) m/s at `VelocityModel.points`, t = 1 … T; p = 0 where nobody is asked for the flow"""


class Vessel(Protocol):
    """What holds the liquid, with electrodes on its wall: a frozen dataclass of SI numbers."""

    @property
    def contact_impedance(self) -> float:
        """z in Ω·m²."""

    @property
    def molar_conductivity(self) -> float:
        """Λ in S·m²/mol; σ = Λc."""

    @property
    def n_electrodes(self) -> int:
        """L."""

    @property
    def patches(self) -> tuple[int, int]:
        """Along x and y: the coarse grid on which an agent sees an estimate."""

    @property
    def is_long(self) -> bool:
        """Whether pictures of it are laid one below the other."""

    def carrier(self, fine: bool) -> tuple[Mesh, np.ndarray]:
        """The mesh on which concentration moves, ``fine`` for the truth, and its inlet's nodes."""

    @property
    def parts_of_a_step(self) -> int:
        """Steps of the truth's transport in a time step."""

    def substeps(self, fine: bool) -> int:
        """Crank–Nicolson steps in each of them, or in a time step of the model."""

    def electrode_model(self, fine: bool) -> CompleteElectrodeModel:
        """The complete electrode model, on a mesh of its own."""


class Flow(Protocol):
    """How the fluid moves: a frozen dataclass of SI numbers. What is said here is the default."""

    @property
    def diffusivity(self) -> float:
        """κ in m²/s; of the estimators' model where the truth is not carried."""

    def nominal(self, world: World, fine: bool) -> VelocityField | None:
        """The velocity of the truth (``fine``) or the estimators' model; None: nothing moves."""

    def check_assumed(self, world: World, assumed: Mapping[str, Any]) -> None:
        """``ValueError`` if `believed` knows nothing of what is assumed; at no cost."""
        refuse_assumptions(assumed, ())

    def believed(self, world: World, **assumed: Any) -> VelocityField | None:
        """The velocity of the estimators' model; ``assumed``: what they are told instead."""
        self.check_assumed(world, assumed)
        return self.nominal(world, fine=False)

    def flush_steps(self, world: World) -> int:
        """Time steps in which the mean flow passes through the vessel; 0 where nothing does."""
        return 0

    def lead_in(self, world: World) -> int:
        """Time steps that the fluid flows before t = 0: the slowest flow has flushed the vessel."""
        return self.flush_steps(world)

    def velocity_model(self, world: World) -> VelocityModel | None:
        """How the flow may be written where it is to be estimated too."""
        return None

    def draw(self, world: World,
             random: np.random.Generator) -> Callable[[int], SkewedChannelFlow] | None:
        """t -> the flow from t − 1 to t in one episode; None: the nominal one in all of them."""
        return None

    def true_transport(self, world: World, model: Discretisation,
                       random: np.random.Generator) -> Callable[[int], Transport]:
        """See `World.true_transport`."""
        drawn = self.draw(world, random)
        if drawn is None:
            return lambda t: model.transport
        from eitbench.physics.transport import ConvectionDiffusion
        assert isinstance(model.transport, ConvectionDiffusion)
        at = lru_cache(maxsize=1)(model.transport.with_velocity)
        return lambda t: at(drawn(t))


def refuse_assumptions(assumed: Mapping[str, Any], known: Sequence[str]) -> None:
    """``ValueError`` if estimators are told something that this flow knows nothing of."""
    for name in assumed:
        if name not in known:
            there = f"there are {', '.join(known)}" if known else "this world has nothing to assume"
            raise ValueError(f"assume has no {name!r}; {there}")


def check_positive(part: object, **units: str) -> None:
    """``ValueError`` unless these numbers of a part, each with its unit, are above 0."""
    for name, unit in units.items():
        _check.number(name, getattr(part, name), low=0.0, open_low=True, units=unit)


def check_range(part: object, name: str, units: str = "", open_low: bool = True) -> None:
    """``ValueError`` unless this pair of a part's numbers is 0 < low ≤ high, or 0 ≤ low ≤ high."""
    given = getattr(part, name)
    low, high = _check.array(name, given, (2,), units=units)
    if not 0 <= low <= high or (open_low and low == 0):
        least = ("> 0" if open_low else "≥ 0") + (f" in {units}" if units else "")
        raise ValueError(f"{name} must be a range low ≤ high of numbers {least}, got {given!r}")


class Target(Protocol):
    """What is to be seen: a frozen dataclass of SI numbers."""

    @property
    def background(self) -> float:
        """Concentration (mol/m³) that fills the vessel at first."""

    @property
    def is_carried(self) -> bool:
        """Whether the fluid carries the truth; else the target has a way of its own."""

    @property
    def stands_still(self) -> bool:
        """Whether nothing has to be followed: such worlds have boards of their own."""
        return False

    def evolve(self, world: World, episodes: Sequence[Randomness], truth: Discretisation,
               tick: Callable[[int], object], last: int) -> Iterator[History]:
        """What moves in each episode up to state ``last``; to the bit the same beside any others.

        ``tick(k)`` is called when k more steps of one episode are done.
        """


@dataclass(frozen=True)
class Prior:
    """What is believed before any measurement; deviations in parts of ĉ_bh (thesis Table 5.1)."""

    expected_concentration: float = 25.0
    """mol/m³; a rough level, deliberately not the background [ours]"""
    inflow_std: float = 1 / 4
    """of the inflow noise η [T]"""
    nodal_std: float = 1 / 50
    """of the nodal noise e [ours; illegible in the table]"""
    initial_std: float = 1 / 4
    """of the initial state [ours; illegible in the table]"""
    initial_length: float = 0.0
    """m over which the initial state is smooth; 0: nodes are independent"""

    def __post_init__(self) -> None:
        check_positive(self, expected_concentration="mol/m³")
        for name in ("inflow_std", "nodal_std", "initial_std"):
            _check.number(name, getattr(self, name), low=0.0)
        _check.number("initial_length", self.initial_length, low=0.0, units="m")
