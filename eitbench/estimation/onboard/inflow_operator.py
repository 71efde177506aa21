"""The estimators inside an injection environment that have learned what flows in: filters of the
inflow's history (``docs/methods.md``, 10), in few coordinates for training and exact for scores.

Both are `baselines/log_inflow_filter.py` about the level of the first frame. What they know of the
inflow is learned from training inflows, without a simulation, in the world's own steps.
"""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from eitbench._notice import say
from eitbench.data.seeds import SPLITS
from eitbench.estimation.filter import Filter, Step
from eitbench.estimation.gaussian import Observation
from eitbench.estimation.inflow_prior import InflowPrior, learned_inflow_prior
from eitbench.estimation.inflow_response import Response, reduced_response, steady_response
from eitbench.estimation.inflow_window import InflowWindow, stationary
from eitbench.estimation.onboard.operator import BROKEN, Innovation, Linearisation, spread
from eitbench.estimation.onboard.reduced_operator import ReducedOperator, Shared
from eitbench.estimation.quadratic_voltages import ScaledVoltages
from eitbench.worlds.task import make_task

if TYPE_CHECKING:
    from eitbench.worlds.world import World

EPISODES = 200
"""Training inflows that the prior is learned from, the first ones."""
STEPS = 80
"""Scored steps of these, whatever the world has: short records would not show how inflows last."""
DIRECTIONS = 100
"""Of the concentration in training: with half as many ẽ_c is 0.5 % larger."""
BENT = 32
"""The first of them, in which voltages are quadratic."""


class InflowOperator(ReducedOperator):
    """Extended Kalman filters of the inflow's logarithm in the last steps; see `Operator`.

    What is estimated are the window's entries x_t … x_{t−W+1}, W·r = s of them, each of variance 1
    before anything is measured; `state` is what follows for the concentration. Voltages are
    linearised about each prediction, there quadratic in the concentration's logarithm.
    """

    _shared: InflowShared

    def __init__(self, world: World, frames: np.ndarray, *, gate: float,
                 noise_floor: float) -> None:
        self._shared = shared = self._share(world)
        self._gate = gate
        self._floor = noise_floor
        broken = BROKEN if math.isfinite(gate) else math.inf
        levels = shared.levels
        self.concentration = np.array([levels.concentration(levels.best(frame, broken))
                                       for frame in frames])
        self._filters = self._start()
        self._taken: list[Innovation | None] = []
        for k, currents in enumerate(world.currents):
            self.assimilate(frames[:, k], np.repeat(currents[None], len(frames), axis=0))

    def _start(self) -> list[Filter]:
        """Filters at t = 0."""
        shared = self._shared
        self._spaces = [InflowWindow(shared.levels.task, shared.prior, float(level),
                                     responses=[shared.model]) for level in self.concentration]
        return [Filter(space, gate=self._gate) for space in self._spaces]

    @staticmethod
    def _share(world: World) -> InflowShared:
        return InflowShared.of(world)

    def __getstate__(self) -> dict[str, Any]:
        """Of the filters what they know, without what all episodes share."""
        known = [(each.mean, each.covariance) for each in self._filters]
        return {name: value for name, value in vars(self).items()
                if name not in ("_filters", "_spaces", "_ahead")} | {"known": known}

    def __setstate__(self, state: dict[str, Any]) -> None:
        known = state.pop("known")
        vars(self).update(state)
        self._filters = self._start()
        for filter_, (mean, covariance) in zip(self._filters, known, strict=True):
            filter_.mean = mean
            filter_.covariance = covariance

    def assimilate(self, voltages: np.ndarray,
                   currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        vars(self).pop("_ahead", None)
        innovations = np.zeros_like(voltages)
        kept = np.ones(voltages.shape, dtype=bool)
        self._taken = [None] * len(voltages)
        for b, filter_ in enumerate(self._filters):
            filter_.predict()
            if not currents[b].any():
                continue
            step = self._condition(filter_, voltages[b], currents[b])
            value, S, kept[b] = step.innovation, step.innovation_covariance, step.accepted
            innovations[b] = value / np.sqrt(S.diagonal())
            if kept[b].any():
                self._taken[b] = Innovation(value[kept[b]], S[np.ix_(kept[b], kept[b])])
        return innovations, kept

    def _condition(self, filter_: Filter, voltages: np.ndarray, currents: np.ndarray) -> Step:
        """Condition on a measurement (L,) of the predicted state."""
        point = filter_.concentration
        computed, matrix = (array[0] for array in
                            self._shared.voltages.linearise(point, currents[None]))
        std = self._shared.levels.noise_std(computed, self._floor)
        return filter_.update(Observation(matrix, voltages - computed + matrix @ point, std**2))

    def innovations(self) -> list[Innovation | None]:
        return self._taken

    @cached_property
    def _ahead(self) -> Filter:
        """The first episode's filter one step on, before its measurement; a new one each step."""
        ahead = copy.copy(self._filters[0])
        ahead.covariance = ahead.covariance.copy()
        ahead.predict()
        return ahead

    @property
    def linearised(self) -> Linearisation:
        """About what is predicted of the first episode."""
        point = self._ahead.concentration
        L = self._shared.world.currents.shape[1]
        each = np.eye(L) - 1.0 / L  # a potential that all share does not count
        resistance, by_c = self._shared.voltages.linearise(point, each)
        by_state = self._spaces[0].jacobian(self._ahead.mean, by_c.reshape(L * L, -1))
        return Linearisation(float(self.concentration[0]), resistance, by_state.reshape(L, L, -1))

    def relinearised(self) -> np.ndarray:
        """`linearised` is so already."""
        return self.linearised.derivative

    @property
    def state(self) -> np.ndarray:
        return np.array([space.coordinates(each.mean)
                         for space, each in zip(self._spaces, self._filters, strict=True)])

    @property
    def state_covariance(self) -> np.ndarray:
        return np.array([slope @ P @ slope.T
                         for slope, P in zip(self._slopes(), self.covariance, strict=True)])

    @property
    def covariance(self) -> np.ndarray:
        return np.array([each.covariance.array for each in self._filters])

    def _slopes(self) -> list[np.ndarray]:
        """Derivatives (q, s) of each concentration, relative to its level, by the window."""
        return [space.slope(each.mean) / space.level
                for space, each in zip(self._spaces, self._filters, strict=True)]

    def grid(self) -> tuple[np.ndarray, np.ndarray]:
        patches = self._shared.patches
        mean = 1.0 + (patches @ self.state[..., None])[..., 0]
        variance = [each.covariance.variance_of(patches @ slope)
                    for slope, each in zip(self._slopes(), self._filters, strict=True)]
        level = self.concentration[:, None]
        return level * mean, level * spread(np.array(variance))

    def steps(self, count: int,
              along: np.ndarray | None = None) -> list[tuple[np.ndarray, np.ndarray]]:
        """The same at every step, whatever the state."""
        return [self._shared.step] * count

    @property
    def weight(self) -> np.ndarray:
        """About what is predicted of the first episode."""
        slope = self._spaces[0].slope(self._ahead.mean) / self._spaces[0].level
        return np.asarray(slope.T @ self._shared.mass[1:, 1:] @ slope)

    def truth(self, entries: np.ndarray) -> np.ndarray:
        """``ValueError``: a recording does not say what flowed in."""
        raise ValueError("world must have a flow that is to be estimated; where it is known the "
                         "truth does not change what an injection teaches")


class InflowShared(Shared):
    """What all episodes of a world share whose filters have learned what flows in."""

    model: Response

    def __init__(self, world: World) -> None:
        super().__init__(world)
        self.prior = prior_of(world)
        self.voltages = self._voltages()

    @staticmethod
    def _make(world: World) -> Response:
        response = steady_response(make_task(world).transport)
        return reduced_response(response, prior_of(world), DIRECTIONS)

    def _voltages(self) -> Any:
        return ScaledVoltages(self.levels.task.observation, self.world.expected_concentration,
                              self.model.basis[:, :BENT])

    @cached_property
    def step(self) -> tuple[np.ndarray, np.ndarray]:
        """(s, s) each: how a window moves on, and the noise of what enters it."""
        W = self.model.weights.shape[1]
        r = self.prior.modes.shape[1]
        weights, variance = stationary(self.prior.time_covariance(W + 1))[1]
        transition = np.eye(W * r, k=-r)
        transition[:r] = np.kron(weights, np.eye(r))
        noise = np.zeros_like(transition)
        noise[:r, :r] = variance * np.eye(r)
        return transition, noise


class InflowFullOperator(InflowOperator):
    """The same in all directions that inflows reach, with the potential solved for at each
    prediction, some 12 ms a step: what scored runs use."""

    @staticmethod
    def _share(world: World) -> InflowShared:
        return InflowFullShared.of(world)


class InflowFullShared(InflowShared):
    """The same for the exact filters."""

    @staticmethod
    def _make(world: World) -> Response:
        return steady_response(make_task(world).transport)

    def _voltages(self) -> Any:
        return self.levels.task.observation


@lru_cache(maxsize=4)
def prior_of(world: World) -> InflowPrior:
    """What training inflows of a world show."""
    say(f"learning what flows in in {world.name}, some seconds once a process")
    longer = replace(world, schedule=replace(world.schedule, scored_steps=STEPS))
    return learned_inflow_prior(longer, SPLITS["train"][:EPISODES])
