"""Estimate the concentration from the voltages: environments of the estimation ids."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from gymnasium import spaces

from eitbench import _check
from eitbench.data.episode_cache import (
    cycle_voltages,
    score_mass,
    scoring_constants,
    step_error,
    velocity_error,
)
from eitbench.envs.episodes import EpisodeCore, EpisodeEnv, EpisodeVectorEnv, Observation
from eitbench.worlds.random_streams import episode_streams
from eitbench.worlds.registry import entry
from eitbench.worlds.task import lag_steps, make_task
from eitbench.worlds.world import Discretisation, World

if TYPE_CHECKING:
    from eitbench.data.episodes import Episode
    from eitbench.physics.transport import Transport


class PrivilegedInfo(NamedTuple):
    """Data of the episode that only oracles are given."""

    voltages: np.ndarray
    """(T, L) V, all steps of the episode"""
    currents: np.ndarray
    """(T, L) A (A/m in 2D)"""
    transport: Callable[[int], Transport]
    """t = 1 … T -> the model, on the task's mesh, with the true flow from t − 1 to t"""
    velocity: np.ndarray
    """(T, p) axial velocity in m/s at `VelocityModel.points`; p = 0 where it is not estimated"""


class EstimationCore(EpisodeCore):
    """B episodes with the world's cycle of injections, whose actions are estimates."""

    estimate_std: np.ndarray | None = None
    """(n,) standard deviation of the last estimate in mol/m³ for images, if the caller has one"""

    def __init__(self, world: World, lag: int, assumed: dict[str, Any]) -> None:
        super().__init__(world, lag=lag, **assumed)
        self.lag = lag
        self.length = world.n_steps + lag
        cycle = world.currents
        self.currents = np.zeros((self.length + 1, cycle.shape[1]))
        """(T + lag + 1, L) A (A/m in 2D) of every step and after the last: the cycle, then 0"""
        self.currents[:world.n_steps] = cycle[np.arange(world.n_steps) % len(cycle)]
        stage = scoring_constants(world)
        self.n_nodes: int = stage.mass.shape[0]
        voltage = 100.0 * stage.largest_voltage
        current = np.abs(cycle).max()
        self.observation_space = spaces.Dict({
            "voltages": spaces.Box(-voltage, voltage, cycle.shape[1:], np.float64),
            "currents": spaces.Box(-current, current, cycle.shape[1:], np.float64)})
        limit = np.full(self.n_nodes, 10.0 * world.expected_concentration)
        velocity = world.velocity_model
        if velocity is not None:
            limit = np.append(limit, np.full(velocity.n_parameters, 10.0 * max(velocity.nominal)))
        self.action_space = spaces.Box(-limit, limit, dtype=np.float64)

    def reset(self, seeds: Sequence[int],
              provide: Callable[[World, int], None] | None = None) -> None:
        self._step = 1
        self._errors = np.full(len(seeds), np.nan)
        self._estimates = np.full((len(seeds), self.n_nodes), self.world.expected_concentration)
        self.estimate_std = None
        super().reset(seeds, provide)

    def _read(self, recordings: Sequence[np.ndarray], moments: Sequence[np.ndarray]) -> None:
        world = self.world
        self.voltages = np.zeros((self.length + 1, len(recordings), self.currents.shape[1]))
        """(T + lag + 1, B, L) V of the steps that are loaded, else 0"""
        k = slice(self._known)
        for b, (seed, entries) in enumerate(zip(self.seeds, recordings, strict=True)):
            self.voltages[k, b] = cycle_voltages(world, seed, entries[k])
        self._moments = [moment[world.warm_up:].copy() for moment in moments]
        if world.velocity_model is not None:
            self._flows = [(entries["velocity_moment"].copy(), entries["velocity_square"].copy())
                           for entries in recordings]

    def check(self, action: Any, space: Any) -> np.ndarray:
        return check_actions(action, space, self.n_nodes)

    def act(self, actions: np.ndarray) -> np.ndarray:
        world = self.world
        k = self._step - self.lag - 1
        self._step += 1
        if k >= 0:
            self._estimates = actions[:, :self.n_nodes].copy()
        self._errors = np.full(len(actions), np.nan)
        if k < world.warm_up:
            return np.zeros(len(actions))
        estimates, parameters = np.split(actions, [self.n_nodes], axis=1)
        moments = np.stack([each[k - world.warm_up] for each in self._moments])
        self._errors = step_error(score_mass(world), estimates - world.background, moments,
                                  self._deviations[k], self._squares[k])
        rewards = -self._errors
        if world.velocity_model is not None:
            moments, squares = (np.stack([flow[i][k] for flow in self._flows]) for i in range(2))
            rewards = rewards - velocity_error(world.velocity_model, parameters, moments, squares)
        return rewards

    def errors(self) -> np.ndarray:
        return self._errors

    def picture(self, b: int) -> tuple[int, np.ndarray, np.ndarray | None, np.ndarray]:
        t = min(max(self._step - 1 - self.lag, 0), self.world.n_steps)
        currents = self.currents[t - 1] if t else np.zeros(self.currents.shape[1])
        return t, self._estimates[b], self.estimate_std, currents

    def observe(self) -> Observation:
        self.load_until(self._step)
        voltages = self.voltages[self._step - 1]
        currents = self.currents[self._step - 1]
        return {"voltages": voltages.copy(),
                "currents": np.repeat(currents[None], len(voltages), axis=0)}


class EstimationEnv(EpisodeEnv):
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
    −∫(v̂_t − v_t)² dy / ∫v_t² dy across the pipe is added. For scored states `info["error"]` is the
    relative error of the concentration.

    ## Starting State

    `reset(seed=s)` starts episode s; the splits train, dev and test have separate ranges of seeds.
    Without a seed, a random training episode is drawn, from few at first. The first use of a seed
    simulates the ground truth and caches it; `eitbench bank` does so in advance.

    ## Episode End

    Terminated after T + lag steps. Never truncated.

    ## Arguments

    | name | default | meaning |
    |---|---|---|
    | `lag` | set by the id | integer from 0 to T − 1, or "all" (= T − 1): all measurements first |
    | `assume` | set by the id | dict of wrong assumptions on the flow in the task's model |
    | `variant` | None | name of a robustness variant, as "strong-slugs" of `eitbench/Pipe2D-v0` |
    | `world` | None | numbers to change, as in `{"instrument": {"noise_relative": 0.02}}` |
    | `episodes` | None | episodes of unseeded resets; None: 1, 8, … up to 1000, of dev 32 |
    | `split` | "train" | split of unseeded resets: "train", or "dev" for evaluation |
    | `render_mode` | None | "rgb_array": truth, estimate, standard deviation, active pair |
    """

    core: EstimationCore

    def __init__(self, name: str, *, variant: str | None = None,
                 world: dict[str, Any] | None = None, lag: int | str | None = None,
                 assume: dict[str, Any] | None = None, episodes: int | None = None,
                 split: str = "train", render_mode: str | None = None) -> None:
        core = EstimationCore(*resolve_arguments(name, variant, world, lag, assume))
        super().__init__(core, episodes, split, render_mode)
        self.lag = core.lag
        self.n_nodes = core.n_nodes
        """nodes of the mesh of the estimates"""

    def truth(self) -> np.ndarray:
        """(T, n_truth) concentration in mol/m³, t = 1 … T; for scoring, never for agents."""
        return self._episode("truth()").concentration[1:].astype(float)

    def true_velocity(self) -> np.ndarray:
        """(T, p) axial velocity in m/s at `VelocityModel.points`; for scoring, never for agents."""
        return self._episode("true_velocity()").velocity

    def privileged_info(self) -> PrivilegedInfo:
        """Return the measurements and the true flow of this episode, for oracles only."""
        velocity = self._episode("privileged_info()").velocity.copy()
        n_steps = self.world.n_steps
        self.core.load_until(n_steps)
        correct = make_task(self.world, self.lag)
        transport = self.world.flow.true_transport(
            self.world, Discretisation(correct.transport, correct.observation),
            episode_streams(self.core.seeds[0]).flow)
        return PrivilegedInfo(self.core.voltages[:n_steps, 0].copy(),
                        self.core.currents[:n_steps].copy(), transport, velocity)

    def _episode(self, caller: str) -> Episode:
        from eitbench.data.episodes import simulate
        self.require_reset(caller)
        return simulate(self.world, self.core.seeds[0])


class EstimationVectorEnv(EpisodeVectorEnv):
    """`EstimationEnv`, many times; see there and `EpisodeVectorEnv`."""

    def __init__(self, name: str, *, num_envs: int = 1, episodes: int | None = None,
                 split: str = "train", render_mode: str | None = None,
                 max_episode_steps: int | None = None, **arguments: Any) -> None:
        super().__init__(lambda: EstimationCore(*resolve_arguments(name, **arguments)), num_envs,
                         episodes, split, render_mode, max_episode_steps)


def resolve_arguments(name: str, variant: str | None = None, world: dict[str, Any] | None = None,
                      lag: int | str | None = None, assume: dict[str, Any] | None = None,
                      ) -> tuple[World, int, dict[str, Any]]:
    """Return the world, the lag and the assumptions on the flow of an id with these arguments;
    ``ValueError`` names an argument that is not allowed."""
    registered = entry(name, variant)
    changed = registered.world.with_changes(world)
    assumed = registered.settings.get("assume", {}) if assume is None else assume
    if not isinstance(assumed, Mapping):
        raise ValueError(f"assume must be a dict of assumptions on the flow, got {assumed!r}")
    if assumed:
        changed.flow.assumed_velocity(changed, **assumed)
    steps = lag_steps(changed, registered.settings.get("lag", 0) if lag is None else lag)
    return changed, steps, dict(assumed)


def check_actions(actions: Any, space: Any, n_nodes: int) -> np.ndarray:
    """Return ``actions`` as float64 in the `Box` ``space``; ``ValueError`` names what is wrong.

    The first ``n_nodes`` numbers are concentrations, the others velocities.
    """
    plain = (type(actions) is np.ndarray and actions.shape == space.shape
             and actions.dtype == np.float64)
    if plain and (np.abs(actions) <= space.high).all():             # false for NaN too
        return np.asarray(actions)
    checked = _check.array("action", actions, space.shape, units="mol/m³")
    outside = np.argwhere(np.abs(checked) > space.high)
    if len(outside):
        place = tuple(outside[0])
        units = "mol/m³" if place[-1] < n_nodes else "m/s"
        raise ValueError(f"action must lie within ±{space.high[place]:g} {units}, "
                         f"got {abs(checked[place]):g}")
    return checked
