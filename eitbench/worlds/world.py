"""Simulation configuration (a world): vessel, flow, target, instrument, schedule and prior."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from eitbench import _check
from eitbench.physics.observation import LinearConductivity, ObservationModel, VoltageNoise
from eitbench.worlds.fields import check_not_negative, check_positive
from eitbench.worlds.instrument import Instrument
from eitbench.worlds.random_streams import EpisodeStreams, episode_streams
from eitbench.worlds.schedule import Schedule
from eitbench.worlds.stored_names import add_current_members

if TYPE_CHECKING:
    import scipy.sparse as sp

    from eitbench.numerics.mesh import Mesh
    from eitbench.physics.cem import CompleteElectrodeModel
    from eitbench.physics.flow import RoundPipeFlow
    from eitbench.physics.profiles import SkewedChannelFlow, VelocityModel
    from eitbench.physics.transport import Transport, VelocityField


class Discretisation(NamedTuple):
    """Transport and observation model of a world on meshes."""

    transport: Transport
    observation: ObservationModel


class TruthTrajectory(NamedTuple):
    """Ground truth of one episode."""

    concentration: np.ndarray
    """(T + 1, n) mol/m³ at the nodes of the truth's CD mesh, t = 0 … T"""
    velocity: np.ndarray
    """(T, p) m/s at `VelocityModel.points`, t = 1 … T; p = 0 if the task does not request it"""


class Vessel(Protocol):
    """A container with electrodes on its wall: a frozen dataclass of SI numbers."""

    contact_impedance: float
    """z in Ω·m²"""
    molar_conductivity: float
    """Λ in S·m²/mol; σ = Λc"""
    n_electrodes: int
    """L"""
    coarse_grid_shape: tuple[int, int]
    """cells along x and y of the grid on which an agent observes the estimate"""
    is_elongated: bool
    """True if figures stack its images vertically"""
    n_truth_steps: int
    """transport steps of the truth in a time step"""

    def transport_mesh(self, fine: bool) -> tuple[Mesh, np.ndarray]:
        """Return the transport mesh, ``fine`` for the truth, and the nodes of its inlet."""

    def substeps(self, fine: bool) -> int:
        """Return the Crank–Nicolson steps in a transport step of the truth or of the model."""

    def electrode_model(self, fine: bool) -> CompleteElectrodeModel:
        """Return the complete electrode model, on a separate mesh."""


class Flow(Protocol):
    """A flow configuration: a frozen dataclass of SI numbers. This class holds the defaults."""

    diffusivity: float
    """κ in m²/s; for the estimator model only, if the truth is not advected"""

    def nominal(self, world: World, fine: bool) -> VelocityField | None:
        """Return the velocity of the truth (``fine``) or the estimator model; None: no flow."""

    def assumed_velocity(self, world: World, **assumed: Any) -> VelocityField | None:
        """Return the velocity of the estimator model under other assumptions than the default;
        ``ValueError`` for an assumption that it does not accept."""
        reject_unknown_assumptions(assumed, ())
        return self.nominal(world, fine=False)

    def residence_steps(self, world: World) -> int:
        """Return the time steps in which the mean flow passes the vessel; 0 without a flow."""
        return 0

    def spin_up_steps(self, world: World) -> int:
        """Return the time steps before t = 0 in which the slowest flow passes the vessel."""
        return self.residence_steps(world)

    def velocity_model(self, world: World) -> VelocityModel | None:
        """Return the parametrisation of the flow if the task requests its estimate."""
        return None

    def draw(self, world: World, random: np.random.Generator,
             ) -> Callable[[int], SkewedChannelFlow | RoundPipeFlow] | None:
        """Draw t -> the flow from t − 1 to t of an episode; None: all have the nominal flow."""
        return None

    def true_transport(self, world: World, model: Discretisation,
                       random: np.random.Generator) -> Callable[[int], Transport]:
        """Return t -> an episode's true transport from t − 1 to t, on the mesh of ``model``.

        For oracles. ``model`` is the estimator model without wrong assumptions, ``random`` the
        unused stream of the episode.
        """
        drawn = self.draw(world, random)
        if drawn is None:
            return lambda t: model.transport
        from eitbench.physics.transport import ConvectionDiffusion
        assert isinstance(model.transport, ConvectionDiffusion)
        at = lru_cache(maxsize=1)(model.transport.with_velocity)
        return lambda t: at(drawn(t))


class Target(Protocol):
    """A moving or stationary concentration field: a frozen dataclass of SI numbers."""

    background: float
    """initial concentration (mol/m³) of the whole vessel"""
    is_advected: bool
    """True if the flow advects the truth; otherwise the target computes its own motion"""
    is_stationary: bool = False
    """True if the truth is stationary; such worlds have separate subtracks"""

    def evolve(self, world: World, episodes: Sequence[EpisodeStreams], truth: Discretisation,
               tick: Callable[[int], object], last: int) -> Iterator[TruthTrajectory]:
        """Simulate episodes up to state ``last``; results are bitwise the same in any batch.

        ``tick(k)`` is called after k further steps of one episode.
        """


@dataclass(frozen=True)
class Prior:
    """Prior of the estimators; standard deviations relative to ĉ_bh (thesis Table 5.1)."""

    expected_concentration: float = 25.0
    """mol/m³; a rough concentration, deliberately not the background [E]"""
    inflow_std: float = 1 / 4
    """of the inflow noise η [T]"""
    nodal_std: float = 1 / 50
    """of the nodal noise e [E; illegible in the table]"""
    initial_std: float = 1 / 4
    """of the initial state [E; illegible in the table]"""
    initial_length: float = 0.0
    """m, correlation length of the initial state; 0: nodes are independent"""

    def __post_init__(self) -> None:
        check_positive(self, expected_concentration="mol/m³")
        check_not_negative(self, inflow_std="", nodal_std="", initial_std="", initial_length="m")


@dataclass(frozen=True)
class World:
    """A simulation configuration of interchangeable parts, frozen dataclasses of plain numbers.

    A part may require more of another part than its protocol, as slugs require an inlet.
    """

    name: str
    """folder of its episodes in the cache"""
    vessel: Any
    """a `Vessel`"""
    flow: Any
    """a `Flow`"""
    target: Any
    """a `Target`"""
    instrument: Instrument = field(default_factory=Instrument)
    """current sources and voltmeters"""
    schedule: Schedule = field(default_factory=Schedule)
    """times and pattern of injections"""
    prior: Prior = field(default_factory=Prior)
    """prior in the task"""
    region: tuple[float, float] | None = None
    """m along the vessel's first axis, to which errors are restricted. None: the whole vessel"""

    def __post_init__(self) -> None:
        for name, protocol in (("vessel", Vessel), ("flow", Flow), ("target", Target)):
            _check_part(name, getattr(self, name), protocol)
        for part in (self.vessel, self.flow, self.target):
            if hasattr(part, "check"):
                part.check(self)
        if self.instrument.max_faulty > self.vessel.n_electrodes - 2:
            raise ValueError("instrument: n_dead_range, n_failing_range and n_loose_range must "
                             "leave two electrodes without fault, got up to "
                             f"{self.instrument.max_faulty} of {self.vessel.n_electrodes}")
        if self.instrument.readings == "chosen":
            _check.integer("instrument.n_voltmeters", self.instrument.n_voltmeters, low=1,
                           high=self.vessel.n_electrodes)
        if self.region is not None:
            self._check_region(self.region)

    def _check_region(self, region: tuple[float, float]) -> None:
        lines = getattr(self.vessel, "n_mesh_lines", None)
        if lines is None:
            kind = type(self.vessel).__name__
            raise ValueError(f"region must be None in a {kind}, got {region!r}")
        length = self.vessel.length
        low, high = ends = _check.array("region", region, (2,), units="m")
        parts = lines * ends / length
        if not 0 <= low < high <= length or np.abs(parts - parts.round()).max() > 1e-6:
            raise ValueError(f"region must be a range 0 ≤ begin < end ≤ {length:g} m with ends at "
                             f"multiples of {length / lines:g} m, lines of both meshes, "
                             f"got {region!r}")

    # -- time --

    @property
    def time_step(self) -> float:
        """Time between two injections in s."""
        return self.schedule.time_step

    @property
    def spin_up_steps(self) -> int:
        """Time steps that the fluid flows before t = 0."""
        return self.flow.spin_up_steps(self)

    @property
    def warm_up(self) -> int:
        """First injections, not scored: by default one residence time, at least one cycle."""
        if self.schedule.warm_up is not None:
            return self.schedule.warm_up
        return max(self.flow.residence_steps(self), len(self.currents))

    @property
    def n_steps(self) -> int:
        """Measured injections, t = 1 … n_steps."""
        return self.warm_up + self.schedule.scored_steps

    @property
    def calibration(self) -> int:
        """First injections, from which estimators compute ĉ_bh."""
        return self.schedule.calibration or len(self.currents)

    # -- injections and measurements --

    @property
    def currents(self) -> np.ndarray:
        """(K, L) injection cycle in A (A/m in 2D); injection t uses row (t − 1) mod K."""
        return self._currents.copy()

    @cached_property
    def _currents(self) -> np.ndarray:
        return self.instrument.current * self.schedule.pattern(self.vessel)

    @property
    def noise(self) -> VoltageNoise:
        """Assumed noise of a fault-free measurement."""
        return self.instrument.noise

    # -- initial state and prior --

    @property
    def background(self) -> float:
        """Concentration (mol/m³) in the vessel at the beginning of the spin-up."""
        return self.target.background

    @property
    def expected_concentration(self) -> float:
        """Rough expectation of a user in mol/m³; not the background."""
        return self.prior.expected_concentration

    @property
    def velocity_model(self) -> VelocityModel | None:
        """Parametrisation of the flow if the task requests its estimate."""
        return self.flow.velocity_model(self)

    # -- discretisations --

    def truth_model(self) -> Discretisation:
        """Return the fine discretisation, which is simulated."""
        velocity = self.flow.nominal(self, fine=True) if self.target.is_advected else None
        return self._discretise(velocity, fine=True)

    def estimator_model(self, **assumed: Any) -> Discretisation:
        """Return the coarser discretisation of the task.

        ``assumed`` holds other assumptions on the flow than the default, such as ``mean_velocity``:
        arguments of `Flow.assumed_velocity`. ``ValueError`` for an unknown one.
        """
        return self._discretise(self.flow.assumed_velocity(self, **assumed), fine=False)

    def sample_inflow(self, seed: int) -> np.ndarray:
        """Draw the inflow of an episode, (spin_up_steps + n_steps + 1, n_inlet) in mol/m³, at the
        nodes of the estimators' inlet from the beginning of the spin-up, without a simulation.

        ``ValueError`` if the target has no inflow.
        """
        seed = _check.integer("seed", seed, low=0)
        if not hasattr(self.target, "draw_inflow"):
            raise ValueError(f"the target must have an inflow, got {type(self.target).__name__}")
        inflow = self.target.draw_inflow(self, episode_streams(seed).inflow)
        return np.array([inflow(self._inlet_points, t * self.time_step)
                         for t in range(-self.spin_up_steps, self.n_steps + 1)])

    @cached_property
    def _inlet_points(self) -> np.ndarray:
        mesh, inlet = self.vessel.transport_mesh(fine=False)
        points: np.ndarray = mesh.points[np.unique(inlet)]
        return points

    def _discretise(self, velocity: VelocityField | None, fine: bool) -> Discretisation:
        # finite elements: cached episodes do not need them
        from eitbench.physics.stationary import StationaryTransport
        from eitbench.physics.transport import ConvectionDiffusion
        mesh, inlet, cem, to_potential = _vessel_models(self.vessel, fine)
        transport: Transport
        if velocity is None:
            transport = StationaryTransport(mesh, self.time_step)
        else:
            parts = self.vessel.n_truth_steps if fine else 1
            transport = ConvectionDiffusion(
                mesh, velocity, self.flow.diffusivity, self.time_step / parts,
                substeps=self.vessel.substeps(fine), inlet=inlet)
        observation = ObservationModel(cem, to_potential,
                                       LinearConductivity(self.vessel.molar_conductivity),
                                       1e-2 * self.expected_concentration)
        return Discretisation(transport, observation)

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return hash(tuple(getattr(self, each.name) for each in fields(self)))

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields without cached values: a hash is valid in one process only."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    # -- variants --

    def with_changes(self, changes: Mapping[str, Any] | None) -> World:
        """Return this world with changes such as ``{"instrument": {"noise_relative": 0.02}}``.

        ``ValueError`` for an unknown part or field, which lists the known ones, or for a value out
        of range.
        """
        if changes is None:
            return self
        if not isinstance(changes, Mapping):
            raise ValueError(f"world must be a dict of parts and their numbers, got {changes!r}")
        if "name" in changes:
            raise ValueError("world must not change its name, the folder of its episodes")
        return _changed(self, changes, "world")

    @cached_property
    def fault_free(self) -> World:
        """Configuration without instrument faults and noise floor.

        Worlds that differ only in these share one reduced filter.
        """
        given = self.instrument
        instrument = Instrument(current=given.current, noise_relative=given.noise_relative,
                                noise_relative_to_max=given.noise_relative_to_max)
        return replace(self, instrument=instrument, schedule=replace(self.schedule, budget=None))

    @cached_property
    def truth_config(self) -> World:
        """Configuration of the ground truth: worlds with the same one share their episodes.

        It includes the current and the contacts, on which transfer resistances depend.
        """
        instrument = Instrument(current=self.instrument.current,
                                contact_impedance_spread=self.instrument.contact_impedance_spread)
        prior = Prior(self.expected_concentration)
        return replace(self.fault_free, instrument=instrument, prior=prior)


@lru_cache(maxsize=4)
def _vessel_models(vessel: Vessel, fine: bool,
                   ) -> tuple[Mesh, np.ndarray, CompleteElectrodeModel, sp.csr_array]:
    """Return the transport mesh, its inlet, the electrode model and the interpolation to its mesh;
    worlds of the same vessel share them."""
    mesh, inlet = vessel.transport_mesh(fine)
    cem = vessel.electrode_model(fine)
    return mesh, inlet, cem, mesh.interpolation_to(cem.mesh.points)


def _check_part(name: str, part: Any, protocol: type) -> None:
    """Raise ``ValueError`` unless a part has all members of its protocol."""
    add_current_members(type(part))
    members = dict.fromkeys(member for member in (*protocol.__annotations__, *vars(protocol))
                            if not member.startswith("_"))
    if missing := [member for member in members if not hasattr(part, member)]:
        raise ValueError(f"{name} must be a {protocol.__name__}, with {', '.join(members)}; got "
                         f"{type(part).__name__} without {', '.join(missing)}")


def _changed(part: Any, changes: Mapping[str, Any], where: str) -> Any:
    known = [each.name for each in fields(part)]
    if isinstance(part, World):
        known.remove("name")
    made: dict[str, Any] = {}
    for name, value in changes.items():
        if name not in known:
            raise ValueError(f"{where} has no {name!r}; there are {', '.join(known)}"
                             + _check.did_you_mean(name, known))
        old = getattr(part, name)
        if is_dataclass(old) and isinstance(value, Mapping):
            made[name] = _changed(old, value, f"{where}.{name}")
        elif is_dataclass(old) and not is_dataclass(value):
            raise ValueError(f"{where}.{name} must be a dict of its numbers, got {value!r}")
        else:
            made[name] = tuple(value) if isinstance(value, list) else value
    try:
        return replace(part, **made)
    except TypeError as error:
        raise ValueError(f"{where} cannot be changed to {dict(changes)!r}: {error}") from None
    except ValueError as error:
        message = str(error)
        raise ValueError(message if message.startswith(where) else f"{where}: {message}") from None


def reject_unknown_assumptions(assumed: Mapping[str, Any], known: Sequence[str]) -> None:
    """Raise ``ValueError`` for assumptions that a flow does not accept."""
    for name in assumed:
        if name not in known:
            there = f"there are {', '.join(known)}" if known else "this world has nothing to assume"
            raise ValueError(f"assume has no {name!r}; {there}")
