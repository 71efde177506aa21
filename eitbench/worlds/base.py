"""What every scenario offers to the simulation and to the estimators' task."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

if TYPE_CHECKING:
    from eitbench.physics.observation import ObservationModel, VoltageNoise
    from eitbench.physics.profiles import VelocityModel
    from eitbench.physics.transport import ConvectionDiffusion


class Discretisation(NamedTuple):
    """A scenario on meshes: how the concentration moves and how it is seen."""

    transport: ConvectionDiffusion
    """or `AtRest`, which stands in where nothing moves by convection and diffusion"""
    observation: ObservationModel


class Prior(NamedTuple):
    """What is believed before anything is measured; standard deviations in parts of ĉ_bh (thesis Table 5.1)."""

    inflow_std: float = 1 / 4
    """of the inflow noise η [T]"""
    nodal_std: float = 1 / 50
    """of the nodal noise e [ours; illegible in the table]"""
    initial_std: float = 1 / 4
    """of the initial state [ours; illegible in the table]"""
    initial_length: float = 0.0
    """m over which the initial state is smooth; 0: nodes are independent"""


class Randomness(NamedTuple):
    """The independent streams that an episode's seed gives."""

    inflow: np.random.Generator
    noise: np.random.Generator
    flow: np.random.Generator


class History(NamedTuple):
    """What moved in one episode."""

    concentration: np.ndarray
    """(T + 1, n) mol/m³ at the nodes of the truth's CD mesh, t = 0 … T"""
    velocity: np.ndarray
    """(T, p) m/s at `VelocityModel.points`, t = 1 … T; p = 0 where nobody is asked for the flow"""


class Scenario(Protocol):
    """A frozen dataclass of plain numbers, SI units; its fields identify what is simulated."""

    def __hash__(self) -> int: ...

    @property
    def time_step(self) -> float:
        """s between two injections."""
        ...

    @property
    def n_steps(self) -> int:
        """Injections measured, t = 1 … n_steps."""
        ...

    @property
    def warm_up(self) -> int:
        """Injections that are measured but not scored."""
        ...

    @property
    def calibration(self) -> int:
        """First injections, from which an estimator finds ĉ_bh: by default one turn of the cycle."""
        return len(self.currents)

    @property
    def lead_in(self) -> int:
        """Time steps that the fluid flows before t = 0."""
        return 0

    @property
    def background(self) -> float:
        """Concentration (mol/m³) that fills the vessel when the lead-in begins."""
        ...

    @property
    def expected_concentration(self) -> float:
        """Rough level in mol/m³ that an operator would expect; not the background."""
        ...

    @property
    def prior(self) -> Prior:
        """What is believed of the target."""
        return Prior()

    @property
    def velocity_model(self) -> VelocityModel | None:
        """How the flow may be written where it is to be estimated too."""
        return None

    @property
    def noise(self) -> VoltageNoise: ...

    @property
    def currents(self) -> np.ndarray:
        """(K, L) injection cycle in A (A/m in 2D); injection t uses row (t − 1) mod K."""
        ...

    def truth(self) -> Discretisation:
        """The fine one that is simulated."""
        ...

    def model(self, *args: Any, **assumptions: Any) -> Discretisation:
        """The coarser one that estimators are given; ``assumptions`` are what they wrongly believe."""
        ...

    def true_transport(self, model: Discretisation, flow: np.random.Generator) -> Callable[[int], ConvectionDiffusion]:
        """t -> what moves an episode's concentration from t − 1 to t, on the estimators' mesh; for references only.

        ``model`` is what estimators are given when they are told nothing wrong, ``flow`` the episode's fresh stream.
        """
        return lambda t: model.transport

    def evolve(self, episodes: Sequence[Randomness], truth: Discretisation, tick: Callable[[int], object],
               ) -> Iterator[History]:
        """What moves in each episode. Its numbers do not depend on the others beside it, to the bit.

        ``tick(k)`` is called when k more steps of one episode are done, ``lead_in + n_steps`` an episode in all.
        """
        ...
