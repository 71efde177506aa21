"""What every scenario offers to the simulation and to the estimators' task."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

if TYPE_CHECKING:
    from eitbench.physics.observation import ObservationModel, VoltageNoise
    from eitbench.physics.transport import ConvectionDiffusion


class Discretisation(NamedTuple):
    """A scenario on meshes: how the concentration moves and how it is seen."""

    transport: ConvectionDiffusion
    observation: ObservationModel


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
    def lead_in(self) -> int:
        """Time steps that the fluid flows before t = 0."""
        ...

    @property
    def background(self) -> float:
        """Concentration (mol/m³) that fills the vessel when the lead-in begins."""
        ...

    @property
    def expected_concentration(self) -> float:
        """Rough level in mol/m³ that an operator would expect; not the background."""
        ...

    @property
    def noise(self) -> VoltageNoise: ...

    @property
    def currents(self) -> np.ndarray:
        """(K, L) injection cycle in A (A/m in 2D); injection t uses row (t − 1) mod K."""
        ...

    @property
    def truth_steps(self) -> int:
        """Steps of the truth's transport per injection."""
        ...

    def truth(self) -> Discretisation:
        """The fine one that is simulated; its transport steps ``time_step / truth_steps``."""
        ...

    def model(self, *args: Any, **assumptions: Any) -> Discretisation:
        """The coarser one that estimators are given; ``assumptions`` are what they wrongly believe."""
        ...

    def draw_inflow(self, rng: np.random.Generator) -> Callable[[np.ndarray, float], np.ndarray]:
        """A random inflow: (points (k, d) in m, time in s) -> concentration (k,) in mol/m³."""
        ...
