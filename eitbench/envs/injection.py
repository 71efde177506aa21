"""Choose the injection: at every step the agent says where the current enters and leaves."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from eitbench import _check
from eitbench._extras import needed_by
from eitbench.data.bank import Pool
from eitbench.data.seeds import warn_of_reserved
from eitbench.envs.estimation import RESET_NEEDED
from eitbench.envs.injection_core import FURTHEST, InjectionCore, scaled
from eitbench.envs.lockstep import LockstepVectorEnv
from eitbench.envs.spec import KnowsItsLength
from eitbench.estimation.onboard.rules import Rules
from eitbench.worlds.registry import entry
from eitbench.worlds.task import Task, make_task

if TYPE_CHECKING:
    from eitbench.envs.estimation import Observation

OBSERVATIONS = ("scaled", "raw")


class InjectionEnv(KnowsItsLength, gym.Env[Any, Any]):  # type: ignore[misc]
    """Choose the current injections of one episode; a Kalman filter inside makes the estimate.

    ## Action Space

    `Discrete(n)`: the number of an electrode pair (0, 1), (0, 2), … (`Rules.pairs`); the
    current enters at the first electrode and leaves at the second. With a budget, the last action
    is no injection. With `instrument.limit`, `Box`: a current for each electrode relative to the
    instrument's current, see `Rules`.

    ## Observation Space

    By default one array with entries of about −1 to 1, limited to ±5 (`scaled`). With
    `observation="raw"` a `Dict` in SI units, `float64`, with the keys below; with
    `estimator="none"` only `voltages`, `currents` and `left`, raw.

    ## Rewards

    For each scored state the difference ∫(ĉ_bh − c_t)² dΩ / ∫c_t² dΩ − ∫(ĉ_t − c_t)² dΩ / ∫c_t² dΩ
    between the error of the homogeneous estimate, which no injection changes, and that of the
    filter; 0 for the other states. The score is ẽ_c (thesis 5.12), the mean of the second term;
    where the world has a `region`, both integrals are over the region. With `estimator="none"` the
    reward is 0.

    ## Starting State

    `reset(seed=s)` starts episode s; the splits train, dev and test have separate ranges of seeds.
    Without a seed, a random training episode is drawn, from few at first. The first frame is
    measured with the world's cycle of injections; from it follow ĉ_bh and the parameters of the
    filter. The agent injects after it; with `estimator="none"` it makes all injections.

    ## Episode End

    Terminated after the last injection. Never truncated.

    ## Arguments

    | name | default | meaning |
    |---|---|---|
    | `estimator` | "reduced" | reduced filter for training; "full": exact, for scores; "none" |
    | `observation` | "scaled" | or "raw" |
    | `gate` | that of the id | the filter rejects readings beyond this many standard deviations |
    | `inflow` | that of the id | inflow prior: "white" noise (Table 5.1), or "learned" |
    | `world` | None | numbers to change, as in `{"schedule": {"budget": 20}}` |
    | `episodes` | None | training episodes of unseeded resets; None: 1, 8, … up to 1000 |
    | `render_mode` | None | "rgb_array": truth, estimate, standard deviation, injection |
    | `threads` | 1 | vector form only: threads of the filters; give BLAS one thread then |
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 8}  # noqa: RUF012 (gymnasium's form)

    def __init__(self, name: str, *, world: dict[str, Any] | None = None,
                 estimator: str = "reduced", observation: str = "scaled",
                 gate: float | None = None, inflow: str | None = None,
                 episodes: int | None = None, render_mode: str | None = None) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be 'rgb_array' or None, got {render_mode!r}")
        self.render_mode = render_mode
        self.pool = Pool(episodes)
        """What unseeded resets draw from."""
        self.rules = asked_for(name, world, gate, inflow, estimator)
        self.world = self.rules.world
        self._core = InjectionCore(self.rules, estimator)
        self.episode_steps = self._core.length
        self._scaled = check_observation(observation, estimator)
        self.observation_space, self.action_space = spaces_of(self._core, self._scaled)
        self._step = 0
        self._seed = -1

    @cached_property
    def task(self) -> Task:
        """What an estimator of one's own may know; built on first use."""
        return make_task(self.world)

    def __getstate__(self) -> dict[str, Any]:
        """All of the episode, so that a copy, also in another process, goes on as this would; not
        the models, which are made again."""
        return {name: value for name, value in vars(self).items() if name != "task"}

    def reset(self, *, seed: int | None = None,
              options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin the episode with this seed (`eitbench.data.seeds`), or a random training one."""
        super().reset(seed=seed)
        if seed is not None:
            self.pool.restart()
        self._seed = self.pool.draw(self.np_random) if seed is None else seed
        warn_of_reserved([self._seed])
        self._core.begin([self._seed], self.pool.provide)
        self._step = 1
        return self._observe(), {"step": 1}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Inject what the action asks for, and measure; ``ValueError`` if there is no such one.

        Currents beyond ±1 are no mistake: they are cut to ±1 before all else, see `Rules`.
        """
        if not 1 <= self._step <= self._core.length:
            raise gym.error.ResetNeeded(RESET_NEEDED)
        space = self.action_space
        if isinstance(space, spaces.Discrete):
            chosen = np.array([_check.integer("action", action, low=0, high=int(space.n) - 1)])
        else:
            chosen = _check.array("action", action, space.shape)[None]  # type: ignore[arg-type]
        reward = float(self._core.act(chosen)[0])
        self._step += 1
        return self._observe(), reward, self._step > self._core.length, False, {"step": self._step}

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """(height, width, 3) uint8: truth, estimate, spread, injection; None without a mode."""
        if self.render_mode is None:
            gym.logger.warn("render() needs gym.make(..., render_mode='rgb_array')")
            return None
        if self._step == 0:
            raise gym.error.ResetNeeded("call reset() before render()")
        from eitbench.data.episodes import truth_discretisation
        from eitbench.data.recordings import concentration_at
        with needed_by("render()"):
            from eitbench.envs.rendering import draw_frame
        mean, spread = self._core.estimate()
        t = self._core.first + self._step - 1
        truth = concentration_at(self.world, self._seed, t, self._core.first + 1)
        return draw_frame(self.task, truth_discretisation(self.world).transport.mesh, truth,
                          mean[0], spread[0], self._core.last_currents[0],
                          t * self.world.time_step, self.world.region)

    def action_masks(self) -> np.ndarray:
        """(actions,) which numbers do something: with the budget spent the last, no injection."""
        return self._core.action_masks()[0]

    @property
    def core(self) -> InjectionCore:
        """What plays the episode; it knows the truth."""
        return self._core

    @property
    def error(self) -> float | None:
        """Relative error (5.12) of the present estimate; None if it is not scored, or nobody's.

        ``ResetNeeded`` before the first episode.
        """
        if self._step == 0:
            raise gym.error.ResetNeeded("call reset() before error")
        error = float(self._core.errors()[0])
        return None if np.isnan(error) else error

    def _observe(self) -> Any:
        seen = {name: array[0] for name, array in self._core.observe().items()}
        return scaled(self.rules, seen) if self._scaled else seen


def asked_for(name: str, changes: dict[str, Any] | None, gate: float | None, inflow: str | None,
              estimator: str) -> Rules:
    """The rules of an id and its arguments; ``ValueError`` if one of them is not allowed."""
    registered = entry(name)
    if gate is None:
        gate = registered.settings.get("gate", np.inf)
    if inflow is None:
        inflow = registered.settings.get("inflow", "white")
    return Rules(registered.world.changed(changes), gate, estimator != "none", inflow)


def check_observation(observation: str, estimator: str) -> bool:
    """Whether observations are to be scaled; without an estimator they are raw."""
    if observation not in OBSERVATIONS:
        known = ", ".join(OBSERVATIONS)
        raise ValueError(f"observation must be one of {known}, got {observation!r}")
    return observation == "scaled" and estimator != "none"


def spaces_of(core: InjectionCore, is_scaled: bool) -> tuple[spaces.Space, spaces.Space]:
    """What one environment shows and takes."""
    raw = core.space()
    if not is_scaled:
        return raw, core.rules.action_space
    zeros: Observation = {name: np.zeros(space.shape or ()) for name, space in raw.items()}
    shown = spaces.Box(-FURTHEST, FURTHEST, scaled(core.rules, zeros).shape, np.float32)
    return shown, core.rules.action_space


class InjectionVectorEnv(LockstepVectorEnv):
    """`InjectionEnv`, many times; parameters as there and in `LockstepVectorEnv`.

    Parameters
    ----------
    threads : int
        How many cores the estimators may use; give BLAS one thread then. The numbers do not depend
        on it.
    """

    def __init__(self, name: str, *, num_envs: int = 1, world: dict[str, Any] | None = None,
                 estimator: str = "reduced", observation: str = "scaled", gate: float | None = None,
                 inflow: str | None = None, episodes: int | None = None, threads: int = 1,
                 max_episode_steps: int | None = None) -> None:
        super().__init__(num_envs, episodes)
        threads = _check.integer("threads", threads, low=1)
        self.rules = rules = asked_for(name, world, gate, inflow, estimator)
        self.world = rules.world
        # The covariances of sixteen filters stay within a core's own memory.
        size = num_envs if estimator == "none" else max(1, min(16, -(-num_envs // threads)))
        self._parts = [slice(first, first + size) for first in range(0, num_envs, size)]
        self._cores = [InjectionCore(rules, estimator) for _ in self._parts]
        self._length = self._cores[0].length
        self._check_length(max_episode_steps)
        self._scaled = check_observation(observation, estimator)
        self._show(*spaces_of(self._cores[0], self._scaled))
        self._threads = threads
        self._start_threads()

    def _start_threads(self) -> None:
        self._pool = ThreadPoolExecutor(self._threads) if self._threads > 1 else None
        self._map = self._pool.map if self._pool else map

    def __getstate__(self) -> dict[str, Any]:
        """All but the threads: a copy has its own."""
        return {name: value for name, value in vars(self).items() if name not in ("_pool", "_map")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._start_threads()

    def close_extras(self, **kwargs: Any) -> None:
        """Let the threads go."""
        if self._pool:
            self._pool.shutdown()

    @property
    def seeds(self) -> tuple[int, ...]:
        """The episodes that are being played."""
        return tuple(seed for core in self._cores for seed in core.seeds)

    def action_masks(self) -> np.ndarray:
        """(num_envs, actions) as in `InjectionEnv`."""
        return np.concatenate([core.action_masks() for core in self._cores])

    def errors(self) -> np.ndarray:
        """(num_envs,) relative errors (5.12), NaN if not scored; for scoring, never for agents."""
        return np.concatenate([core.errors() for core in self._cores])

    def _begin(self, seeds: list[int]) -> None:
        for core, part in zip(self._cores, self._parts, strict=True):
            core.begin(seeds[part])

    def _act(self, actions: np.ndarray) -> np.ndarray:
        chosen = np.asarray(actions)
        space = self.single_action_space
        if isinstance(space, spaces.Box):
            chosen = _check.array("actions", chosen, (self.num_envs, *space.shape))
        else:
            assert isinstance(space, spaces.Discrete)
            if chosen.shape != (self.num_envs,) or not np.issubdtype(chosen.dtype, np.integer):
                raise ValueError(f"actions must be integers of shape ({self.num_envs},), "
                                 f"got {chosen.dtype} of shape {chosen.shape}")
            if chosen.min() < 0 or chosen.max() >= space.n:
                raise ValueError(f"actions must lie in [0, {space.n - 1}], "
                                 f"got {chosen.min()} … {chosen.max()}")
        by_core = [chosen[part] for part in self._parts]
        return np.concatenate(list(self._map(InjectionCore.act, self._cores, by_core)))

    def _observe(self) -> Any:
        shown = list(self._map(InjectionCore.observe, self._cores))
        seen: Observation = {name: np.concatenate([part[name] for part in shown])
                             for name in shown[0]}
        return scaled(self.rules, seen) if self._scaled else seen
