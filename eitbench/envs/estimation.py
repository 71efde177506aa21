"""Estimate the concentration from the voltages: the environment behind every estimation id."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from eitbench import _check
from eitbench._extras import needed_by
from eitbench.data.bank import Pool
from eitbench.data.recordings import (
    concentration_at,
    cycle_voltages,
    integrals,
    outline,
    recording,
    recording_so_far,
    score_mass,
    step_error,
    velocity_error,
)
from eitbench.data.seeds import warn_of_reserved
from eitbench.envs.spec import KnowsItsLength
from eitbench.worlds.registry import entry
from eitbench.worlds.streams import randomness
from eitbench.worlds.task import Task, lag_steps, make_task
from eitbench.worlds.world import Discretisation, World

if TYPE_CHECKING:
    from eitbench.data.episodes import Episode
    from eitbench.numerics.mesh import Mesh
    from eitbench.physics.transport import Transport

Observation = dict[str, np.ndarray]
RESET_NEEDED = "call reset() before step(), and again when an episode has ended"


class Revealed(NamedTuple):
    """What a reference is shown of the episode that is played, and nobody else."""

    voltages: np.ndarray
    """(T, L) V, the whole record"""
    currents: np.ndarray
    """(T, L) A (A/m in 2D)"""
    transport: Callable[[int], Transport]
    """t = 1 … T -> the model, on the task's mesh, with the real flow from t − 1 to t"""
    velocity: np.ndarray
    """(T, p) axial velocity in m/s at `VelocityModel.points`; p = 0 where it is not asked for"""


class EstimationEnv(KnowsItsLength, gym.Env[Observation, np.ndarray]):  # type: ignore[misc]
    """Estimate the concentration of one episode of a world from voltages.

    ## Action Space

    At step i = 1, 2, … the action is the estimate of the state t = i − lag: the concentration at
    the nodes of `task.mesh` in mol/m³. Where the flow is estimated too (`task.velocity`), its k
    parameters θ in m/s follow. The action is ignored while t < 1.

    ## Observation Space

    A `Dict` with the voltages and currents of injection min(i, T); zeros after the T-th injection,
    until every state has been estimated.

    ## Rewards

    −∫(ĉ_t − c_t)² dΩ / ∫c_t² dΩ for each scored state t, 0 for the others: minus the mean over the
    scored states is the relative error ẽ_c (thesis 5.12). Where the flow is estimated too,
    −∫(v̂_t − v_t)² dy / ∫v_t² dy across the pipe is added.

    ## Starting State

    `reset(seed=s)` starts episode s; the splits train, dev and test have separate ranges of seeds.
    Without a seed, a random training episode is drawn, from few at first. The first use of a seed
    simulates its truth and stores it in the cache; `eitbench bank` does so in advance.

    ## Episode End

    Terminated after T + lag steps. Never truncated.

    ## Arguments

    | name | default | meaning |
    |---|---|---|
    | `lag` | that of the id | integer from 0 to T − 1, or "all" (= T − 1): the whole record first |
    | `assume` | that of the id | dict of wrong assumptions on the flow in the task's model |
    | `world` | None | numbers to change, as in `{"instrument": {"noise_relative": 0.02}}` |
    | `episodes` | None | training episodes of unseeded resets; None: 1, 8, … up to 1000 |
    | `render_mode` | None | "rgb_array": truth, estimate, standard deviation, active pair |
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 8}  # noqa: RUF012 (gymnasium's form)

    def __init__(self, name: str, *, world: dict[str, Any] | None = None,
                 lag: int | str | None = None, assume: dict[str, Any] | None = None,
                 episodes: int | None = None, render_mode: str | None = None) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError("render_mode must be None or one of "
                             f"{self.metadata['render_modes']}, got {render_mode!r}")
        self.render_mode = render_mode
        self.pool = Pool(episodes)
        """What unseeded resets draw from."""
        self.spread: np.ndarray | None = None
        """(n,) standard deviation in mol/m³ to draw beside the estimate, for whoever has one."""
        self.world, self.lag, self._assumed = asked_for(name, world, lag, assume)
        # The world played; estimators are given `task` instead.
        self.episode_steps = self.world.n_steps + self.lag
        self._currents = cycle_currents(self.world, self.lag)
        self.observation_space: spaces.Dict  # type: ignore[assignment]
        self.observation_space, self.action_space = estimation_spaces(self.world)
        self.n_nodes = outline(self.world).mass.shape[0]
        """Of the mesh on which estimates live."""
        self._seed: int | None = None
        self._step = 0

    @cached_property
    def task(self) -> Task:
        """What the agent may know; built on first use, since playing needs none of its models."""
        return make_task(self.world, self.lag, **self._assumed)

    def __getstate__(self) -> dict[str, Any]:
        """All of the episode, so that a copy, also in another process, goes on as this would; not
        the models, which are made again."""
        return {name: value for name, value in vars(self).items() if name != "task"}

    def reset(self, *, seed: int | None = None,
              options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Begin the episode with this seed (`eitbench.data.seeds`), or a random training one."""
        super().reset(seed=seed)
        if seed is not None:
            self.pool.restart()
        self._seed = self.pool.draw(self.np_random) if seed is None else seed
        warn_of_reserved([self._seed])
        self._read(recording_so_far(self.world, self._seed, 1))
        self._step = 1
        self.spread = None
        self._last: np.ndarray | None = None
        return self._observe(), {"step": 1}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Take the estimate of the state asked for, (n,) in mol/m³, and of the flow, (k,) in m/s.

        The flow's only where it is asked for. ``ValueError`` if it is not in the action space.
        """
        if self._seed is None or self._step > self.episode_steps:
            raise gym.error.ResetNeeded(RESET_NEEDED)
        action = checked_actions(action, self.action_space, self.n_nodes)  # type: ignore[arg-type]
        estimate, parameters = np.split(action, [self.n_nodes])
        t = self._step - self.lag
        reward = 0.0
        if t >= 1:
            self._last = estimate.copy()
        if t > self.world.warm_up:
            integrals_then = (part[t - 1] for part in self._integrals)
            beyond = estimate - self.world.background
            reward = -float(step_error(score_mass(self.world), beyond, *integrals_then))
            velocity = self.world.velocity_model
            if velocity is not None:
                entry = self._entries[t - 1]
                reward -= float(velocity_error(velocity, parameters, entry["velocity_moment"],
                                               entry["velocity_square"]))
        self._step += 1
        ended = self._step > self.episode_steps
        return self._observe(), reward, ended, False, {"step": self._step}

    def _read(self, entries: np.ndarray) -> None:
        """Play from this; of a beginning the rest is asked for when it is needed."""
        assert self._seed is not None
        self._entries = entries
        self._integrals = integrals(self.world, entries)
        self._voltages = np.zeros_like(self._currents)
        self._voltages[:len(self._entries)] = cycle_voltages(self.world, self._seed, self._entries)

    def _read_until(self, steps: int) -> None:
        """Have so many steps of the episode, or all that it has."""
        if len(self._entries) < min(steps, self.world.n_steps):
            assert self._seed is not None
            self.pool.provide(self.world, self._seed)
            self._read(recording(self.world, self._seed))

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """(height, width, 3) uint8: truth, last estimate, its spread, electrodes, active pair."""
        if self.render_mode is None:
            gym.logger.warn("render() needs gym.make(..., render_mode='rgb_array')")
            return None
        with needed_by("render()"):
            from eitbench.envs.rendering import draw_frame
        t = min(max(self._step - 1 - self.lag, 0), self.world.n_steps)
        if self._seed is None:
            raise gym.error.ResetNeeded("call reset() before render()")
        concentration = concentration_at(self.world, self._seed, t, 1)
        estimate = self._last
        if estimate is None:
            estimate = np.full(self.task.mesh.n_nodes, self.task.expected_concentration)
        currents = self._currents[t - 1] if t else np.zeros_like(self._currents[0])
        return draw_frame(self.task, self.truth_mesh(), concentration, estimate, self.spread,
                          currents, t * self.world.time_step)

    def truth(self) -> np.ndarray:
        """(T, n_truth) concentration in mol/m³, t = 1 … T; for scoring, never for agents."""
        return self._episode("truth").concentration[1:].astype(float)

    def true_velocity(self) -> np.ndarray:
        """(T, p) axial velocity in m/s at `VelocityModel.points`; for scoring, never for agents."""
        return self._episode("true_velocity").velocity

    def reveal(self) -> Revealed:
        """This episode's record and flow; for references, never for agents."""
        velocity = self._episode("reveal").velocity.copy()
        assert self._seed is not None
        n_steps = self.world.n_steps
        self._read_until(n_steps)
        told_nothing_wrong = make_task(self.world, self.lag)
        model = Discretisation(told_nothing_wrong.transport, told_nothing_wrong.observation)
        transport = self.world.true_transport(model, randomness(self._seed).flow)
        return Revealed(self._voltages[:n_steps].copy(), self._currents[:n_steps].copy(),
                        transport, velocity)

    def truth_mesh(self) -> Mesh:
        """The mesh of `truth`."""
        from eitbench.data.episodes import truth_discretisation
        return truth_discretisation(self.world).transport.mesh

    def _episode(self, asked_by: str) -> Episode:
        from eitbench.data.episodes import simulate
        if self._seed is None:
            raise gym.error.ResetNeeded(f"call reset() before {asked_by}()")
        return simulate(self.world, self._seed)

    def _observe(self) -> Observation:
        k = self._step - 1
        self._read_until(self._step)
        return {"voltages": self._voltages[k].copy(), "currents": self._currents[k].copy()}


def asked_for(name: str, changes: dict[str, Any] | None, lag: int | str | None,
              assumed: dict[str, Any] | None) -> tuple[World, int, dict[str, Any]]:
    """The world, the lag, and what models believe, that an id and its arguments ask for;
    ``ValueError`` if one of them is not allowed."""
    registered = entry(name)
    world = registered.world.changed(changes)
    if lag is None:
        lag = registered.settings.get("lag", 0)
    if assumed is None:
        assumed = registered.settings.get("assume", {})
    if not isinstance(assumed, Mapping):
        raise ValueError(f"assume must be a dict of what is believed of the flow, got {assumed!r}")
    believed = dict(assumed)
    world.flow.check_assumed(world, believed)
    return world, lag_steps(world, lag), believed


def estimation_spaces(world: World) -> tuple[spaces.Dict, spaces.Box]:
    """What one environment shows and takes."""
    stage = outline(world)
    voltage = 100.0 * stage.largest_voltage
    current = np.abs(world.currents).max()
    shape = world.currents.shape[1:]
    observed = spaces.Dict({"voltages": spaces.Box(-voltage, voltage, shape, np.float64),
                            "currents": spaces.Box(-current, current, shape, np.float64)})
    limit = np.full(stage.mass.shape[0], 10.0 * world.expected_concentration)
    velocity = world.velocity_model
    if velocity is not None:
        limit = np.append(limit, np.full(velocity.size, 10.0 * max(velocity.nominal)))
    return observed, spaces.Box(-limit, limit, dtype=np.float64)


def cycle_currents(world: World, lag: int) -> np.ndarray:
    """(T + lag + 1, L) currents of every step and after the last: the cycle, then none."""
    cycle = world.currents
    currents = np.zeros((world.n_steps + lag + 1, cycle.shape[1]))
    currents[:world.n_steps] = cycle[np.arange(world.n_steps) % len(cycle)]
    return currents


def checked_actions(actions: np.ndarray, space: spaces.Box, n_nodes: int) -> np.ndarray:
    """``actions`` as float64, finite and in ``space``; else a ``ValueError`` that says what is not.

    The first ``n_nodes`` numbers are concentrations, the others velocities.
    """
    plain = (type(actions) is np.ndarray and actions.shape == space.shape
             and actions.dtype == np.float64)
    if plain and (np.abs(actions) <= space.high).all():             # false for NaN too
        return actions
    checked = _check.array("action", actions, space.shape, units="mol/m³")
    outside = np.argwhere(np.abs(checked) > space.high)
    if len(outside):
        place = tuple(outside[0])
        units = "mol/m³" if place[-1] < n_nodes else "m/s"
        raise ValueError(f"action must lie within ±{space.high[place]:g} {units}, "
                         f"got {abs(checked[place]):g}")
    return checked
