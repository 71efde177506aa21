"""Training episodes without a simulation (``docs/methods.md``, 16)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from eitbench.data.learning.examples import Dataset, Example, cycle_currents, dataset, fitted
from eitbench.data.recordings import faults_of
from eitbench.data.seeds import is_test, name_seed
from eitbench.estimation.identification import recent_inflows
from eitbench.estimation.identified import IdentifiedModel
from eitbench.estimation.quadratic_voltages import QuadraticVoltages
from eitbench.estimation.reduced_transport import ReducedTransport
from eitbench.physics.profiles import SkewedChannelFlow
from eitbench.physics.transport import Transport
from eitbench.worlds.parts import Discretisation
from eitbench.worlds.streams import randomness
from eitbench.worlds.task import Task, make_task
from eitbench.worlds.world import World

SHOWING = range(32)
"""Training episodes whose inflows show the directions in which a concentration moves."""
BENT = 64
"""Modes of ln(c/c_0) in which voltages are quadratic."""
EVERY = 3
"""States this many steps apart show them."""
LEFT = 0x1EF7
"""Sets the draws of what a model leaves apart from an episode's own streams."""


@dataclass(frozen=True, eq=False)
class Surrogate:
    """Makes examples of a world in milliseconds: the episode's own inflow, carried by its own flow
    through the estimators' coarse mesh in few directions; voltages that are quadratic in the
    logarithm of the concentration; and the noise and faults that the episode has.

    Only what is coarse sets it apart from the simulation; there is nothing beneath its nodes, so
    that `Example.unresolved` is zero. What it depends on is made on first use, once.

    ``ValueError`` if the world has no inflow, electrodes whose contacts are drawn for each episode,
    or a flow that is drawn from no range, or if the model is of another task.

    Parameters
    ----------
    world : World
    model : IdentifiedModel, optional
        Learned in this world. Its mean error of voltages is added; and if the flow is always the
        same, its response takes the place of the coarse mesh, with a draw of what that leaves.
    """

    world: World
    model: IdentifiedModel | None = None

    def __post_init__(self) -> None:
        world = self.world
        world.sample_inflow(SHOWING[0])
        if world.instrument.contact_spread:
            raise ValueError("world must have the contacts that are told, got contact_spread = "
                             f"{world.instrument.contact_spread}")
        if self._drawn(SHOWING[0]) is not None and not hasattr(world.flow, "velocity_range"):
            raise ValueError("world's flow must be steady or have a velocity_range, got "
                             f"{type(world.flow).__name__}")
        if self.model is not None and not self.model.suits(self._task):
            raise ValueError("model must be of this world's mesh, injections and told flow, got "
                             f"one of {dict(self.model.source)}")

    def __getstate__(self) -> dict[str, Any]:
        """Without what is derived."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @property
    def source(self) -> dict[str, Any]:
        """What it is made of, fit for JSON."""
        told = None if self.model is None else dict(self.model.source)
        return {"model": told, "bent": BENT}

    def example(self, seed: int) -> Example:
        """That of the episode of this seed; its voltages have the same noise as in truth."""
        world = self.world
        c = self.concentration(seed)
        currents = cycle_currents(world)
        clean = self.voltages(c, currents)
        # the instrument takes transfer resistances: such as give these voltages
        unit = currents / (currents**2).sum(axis=1, keepdims=True)
        resistance = clean[:, :, None] * unit[:, None]
        noise = randomness(seed).noise.standard_normal(clean.shape)
        measured = world.instrument.measure(faults_of(world, seed), np.arange(1, len(c) + 1),
                                            resistance, currents, noise)
        square = np.einsum("tn,nt->t", c, self._mass @ c.T)
        return Example(seed, measured, currents, c.astype(np.float32), np.zeros(len(c)), square,
                       self._velocity(seed))

    def concentration(self, seed: int) -> np.ndarray:
        """(T, n) mol/m³, t = 1 … T."""
        world = self.world
        u = world.sample_inflow(seed) / world.background - 1.0
        if self.model is None or self._drawn(seed) is not None:
            deviation = self._transport.carry(u, self._flows(seed))[-world.n_steps:]
        else:
            deviation = _responding(self.model, u, world.n_steps, seed)
        return world.background * (1.0 + deviation)

    def voltages(self, concentration: np.ndarray, currents: np.ndarray) -> np.ndarray:
        """(T, L) V without noise, for a concentration (T, n) and currents (T, L)."""
        quadratic = self._quadratic
        clean = np.array([quadratic.voltages(c, each[None])[0]
                          for c, each in zip(concentration, currents, strict=True)])
        if self.model is None:
            return clean
        std = self._task.noise.std(clean)
        return clean + [self.model.mean_error(*each) for each in zip(currents, std, strict=True)]

    # -- how the fluid moves --

    def _drawn(self, seed: int) -> Any:
        return self.world.flow.draw(self.world, randomness(seed).flow)

    def _flows(self, seed: int) -> np.ndarray:
        """(lead_in + T, p) parameters of the flow from t − 1 to t, from the lead-in's first on."""
        world = self.world
        times = range(1 - world.lead_in, world.n_steps + 1)
        drawn = self._drawn(seed)
        if drawn is None:
            return np.zeros((len(times), 0))
        return np.array([(flow.mean_velocity, flow.skewness) for flow in map(drawn, times)])

    def _velocity(self, seed: int) -> np.ndarray:
        """(T, k) as in `Example`."""
        model = self.world.velocity_model
        steps = range(1, self.world.n_steps + 1)
        if model is None:
            return np.zeros((len(steps), 0))
        drawn = self._drawn(seed)
        there = np.array([drawn(t).profile(model.points) for t in steps])
        return fitted(model, (there * model.weights) @ model.profiles)

    @cached_property
    def _transport(self) -> ReducedTransport:
        inflows = [self.world.sample_inflow(seed) for seed in SHOWING]
        shown = np.stack(inflows, axis=2) / self.world.background - 1.0
        return ReducedTransport(self._transport_at, self._ranges(), shown)

    def _transport_at(self, parameters: np.ndarray) -> Transport:
        world = self.world
        task = self._task
        if parameters.size:
            velocity, skewness = parameters
            there = SkewedChannelFlow(velocity, world.vessel.half_width, skewness)
            return task.transport.with_velocity(there)  # type: ignore[attr-defined,no-any-return]
        told = Discretisation(task.transport, task.observation)
        return world.true_transport(told, randomness(SHOWING[0]).flow)(1)

    def _ranges(self) -> list[tuple[float, float]]:
        """Of `_flows`."""
        if self._drawn(SHOWING[0]) is None:
            return []
        flow = self.world.flow
        swing = getattr(flow, "swing_range", (0.0, 0.0))[1]
        skew = getattr(flow, "skewness_range", (0.0, 0.0))[1]
        low, high = flow.velocity_range
        return [(low * (1.0 - swing), high * (1.0 + swing)), (-skew, skew)]

    # -- how it is seen --

    @cached_property
    def _task(self) -> Task:
        return make_task(self.world)

    @cached_property
    def _mass(self) -> Any:
        return Dataset("", self.world, ()).mass

    @cached_property
    def _quadratic(self) -> QuadraticVoltages:
        world = self.world
        states = np.concatenate([self.concentration(seed)[::EVERY] for seed in SHOWING])
        u = np.log(states / world.background)
        _, modes = np.linalg.eigh(u.T @ u)
        return QuadraticVoltages(self._task.observation, world.background, modes[:, :-BENT - 1:-1])


def _responding(model: IdentifiedModel, u: np.ndarray, steps: int, seed: int) -> np.ndarray:
    """(T, n) c_t/c_0 − 1 as the model has it, of the inflow's deviation (·, n_inlet)."""
    q, memory, _ = model.weights.shape
    recent = recent_inflows(u, model.across, steps, memory)
    left = np.random.default_rng([seed, LEFT]).standard_normal((steps, q))
    return recent @ model.weights.reshape(q, -1).T @ model.basis.T + left @ model.root.T


def surrogate_dataset(env: str, seeds: str | Sequence[int], *,
                      world: Mapping[str, Any] | None = None,
                      model: IdentifiedModel | None = None) -> Dataset:
    """Examples to learn from that no simulation has made: thousands in minutes (`Surrogate`).

    Parameters
    ----------
    env, seeds, world
        As of `eitbench.dataset`. Of a seed, inflow, flow, noise and faults are those of its
        episode.
    model : IdentifiedModel, optional
        As of `Surrogate`.

    Raises
    ------
    ValueError
        As `dataset` and `Surrogate` do, and for test episodes, even by name: what is reported of
        them is to be true.
    """
    asked = dataset(env, seeds, world=world)
    if tests := [seed for seed in asked.seeds if is_test(seed)]:
        raise ValueError("seeds must not be of test episodes, which have to be true; got "
                         f"{name_seed(tests[0])}")
    return Dataset(env, asked.world, asked.seeds, Surrogate(asked.world, model))
