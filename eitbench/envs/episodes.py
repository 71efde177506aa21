"""Episodes of a simulated world: a core with a batch axis, and a scalar and a vector environment
around it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from eitbench import _check
from eitbench._extras import require_extra
from eitbench.data.episode_cache import (
    cached_episode,
    cached_episode_prefix,
    concentration_at,
    integrals,
)
from eitbench.data.presimulation import EpisodeSampler
from eitbench.data.seeds import warn_test_seeds
from eitbench.worlds.task import Task, make_task
from eitbench.worlds.world import World

Observation = dict[str, np.ndarray]
RESET_NEEDED = "call reset() before step(), and again when an episode has ended"
RENDER_MODES = ["rgb_array"]


class EpisodeCore(ABC):
    """B episodes of a world at the same step: actions in, rewards and observations out.

    Only the first steps of an episode that is not cached are simulated until more are needed.
    """

    n_initial = 0
    """measurements before the first action"""
    length: int
    """steps of an episode"""
    observation_space: spaces.Space
    """of one episode"""
    action_space: spaces.Space
    """of one episode"""
    max_batch: float = 16
    """largest B in a vector environment: the arrays of more do not fit a CPU core's cache"""

    def __init__(self, world: World, **task_options: Any) -> None:
        self.world = world
        self.seeds: tuple[int, ...] = ()
        """episodes in progress"""
        self._task_options = task_options

    @cached_property
    def task(self) -> Task:
        """Information for an estimator; built on first use, since steps need none of its models."""
        return make_task(self.world, **self._task_options)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state of the episodes, so that a copy continues them, also in another process;
        the models of the task are built again."""
        return {name: value for name, value in vars(self).items() if name != "task"}

    def reset(self, seeds: Sequence[int],
              provide: Callable[[World, int], None] | None = None) -> None:
        """Begin these episodes.

        With ``provide``, only the first steps of episodes that are not cached are simulated; it is
        called with the world and each seed when later steps are needed.
        """
        self.seeds = tuple(seeds)
        self._provide = provide
        if provide is None:
            self._load([cached_episode(self.world, seed) for seed in seeds])
        else:
            n_steps = self.n_initial + 1
            self._load([cached_episode_prefix(self.world, seed, n_steps) for seed in seeds])

    def _load(self, recordings: Sequence[np.ndarray]) -> None:
        self._known = min(map(len, recordings))
        """steps that are loaded"""
        counted = [integrals(self.world, entries) for entries in recordings]
        self._deviations, self._squares = (
            np.stack([getattr(each, name)[:self._known] for each in counted], axis=1)
            for name in ("deviation", "square"))
        self._read(recordings, [each.moment for each in counted])

    def load_until(self, t: int) -> None:
        """Load at least the steps 1 … t of each episode."""
        if self._known < min(t, self.world.n_steps):
            assert self._provide is not None
            for seed in self.seeds:
                self._provide(self.world, seed)
            self._load([cached_episode(self.world, seed) for seed in self.seeds])

    @abstractmethod
    def _read(self, recordings: Sequence[np.ndarray], moments: Sequence[np.ndarray]) -> None:
        """Copy other arrays of cached episodes, which are mapped from files that stay open, with
        moments (known steps or more, n)."""

    @abstractmethod
    def check(self, action: Any, space: Any) -> np.ndarray:
        """Return an action in `action_space`, or a batch in a ``space`` with a leading axis;
        ``ValueError`` if it is not."""

    @abstractmethod
    def act(self, actions: np.ndarray) -> np.ndarray:
        """Take valid actions (B, …) and return the rewards (B,)."""

    @abstractmethod
    def errors(self) -> np.ndarray:
        """Return the relative errors (5.12) of the last estimates (B,), NaN where not scored."""

    @abstractmethod
    def observe(self) -> Observation:
        """Return observations in SI units, new arrays (B, …)."""

    def format(self) -> Any:
        """Return observations in `observation_space`, with a leading axis B."""
        return self.observe()

    @abstractmethod
    def picture(self, b: int) -> tuple[int, np.ndarray, np.ndarray | None, np.ndarray]:
        """Return t of the last estimate of episode ``b``, the estimate (n,), its standard deviation
        (n,) if known, and the currents (L,)."""

    def draw(self, b: int) -> np.ndarray:
        """(height, width, 3) uint8: truth, estimate, its standard deviation, electrodes."""
        with require_extra("render()"):
            from eitbench.envs.rendering import draw_frame
        from eitbench.data.episode_cache import truth_mesh
        t, estimate, std, currents = self.picture(b)
        world = self.world
        truth = concentration_at(world, self.seeds[b], t, self.n_initial + 1)
        fields = [("truth", truth_mesh(world), truth), ("estimate", self.task.mesh, estimate)]
        title = "no reported uncertainty" if std is None else "standard deviation of the estimate"
        return draw_frame(self.task, fields, currents, t * world.time_step, (title, std),
                          world.region)


class FixedLengthEnv(gym.Env[Any, Any]):  # type: ignore[misc]
    """An environment whose ``spec`` states the steps of its episodes as ``max_episode_steps``.

    The last step is ``terminated``, and ids are registered without that number, so
    `gymnasium.make` adds no `gymnasium.wrappers.TimeLimit`. An environment made from this spec has
    one, whose last step is ``truncated`` too (``gymnasium.make(spec, max_episode_steps=-1)`` leaves
    it out).
    """

    episode_steps: int
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """Specification that the environment was made from."""
        return self._spec

    @spec.setter
    def spec(self, made_from: EnvSpec | None) -> None:
        self._spec = made_from and replace(made_from, max_episode_steps=self.episode_steps)


def check_render_mode(render_mode: str | None) -> str | None:
    """Return the render mode; ``ValueError`` if it does not exist."""
    if render_mode not in (None, *RENDER_MODES):
        raise ValueError(f"render_mode must be None or one of {RENDER_MODES}, got {render_mode!r}")
    return render_mode


def can_render(env: Any) -> bool:
    """Return whether an image can be drawn: warn without a mode; ``ResetNeeded`` before the first
    episode."""
    if env.render_mode is None:
        gym.logger.warn("render() needs gym.make(..., render_mode='rgb_array')")
        return False
    if env._step == 0:
        raise gym.error.ResetNeeded("call reset() before render()")
    return True


class EpisodeEnv(FixedLengthEnv):
    """One episode of a core at a time."""

    metadata = {"render_modes": RENDER_MODES, "render_fps": 8}  # noqa: RUF012 (gymnasium's form)
    core: EpisodeCore

    def __init__(self, core: EpisodeCore, episodes: int | None, split: str,
                 render_mode: str | None) -> None:
        self.render_mode = check_render_mode(render_mode)
        self.pool = EpisodeSampler(episodes, split)
        """episodes of unseeded resets"""
        self.core = core
        """simulates the episode; its results include the ground truth"""
        self.world = core.world
        """configuration of the simulated truth; estimators are given `task` instead"""
        self.episode_steps = core.length
        self.observation_space = core.observation_space
        self.action_space = core.action_space
        self._step = 0

    @property
    def task(self) -> Task:
        """Information for an estimator."""
        return self.core.task

    def reset(self, *, seed: int | None = None,
              options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin the episode with this seed (`eitbench.data.seeds`), or a random one of the split.
        ``ValueError`` if ``options`` are given."""
        if options:
            raise ValueError(f"options must be None or empty, got {options!r}")
        super().reset(seed=seed)
        if seed is not None:
            self.pool.reset()
        number = self.pool.sample_seed(self.np_random) if seed is None else seed
        warn_test_seeds([number])
        self.core.reset([number], self.pool.ensure_simulated)
        self._step = 1
        return self._observe(), self._info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take an action; ``ValueError`` if it is not in the action space."""
        if not 1 <= self._step <= self.episode_steps:
            raise gym.error.ResetNeeded(RESET_NEEDED)
        checked = self.core.check(action, self.action_space)
        reward = float(self.core.act(checked[None])[0])
        self._step += 1
        ended = self._step > self.episode_steps
        return self._observe(), reward, ended, False, self._info()

    def _info(self) -> dict[str, Any]:
        error = float(self.core.errors()[0])
        return {"step": self._step} | ({} if np.isnan(error) else {"error": error})

    def _observe(self) -> Any:
        shown = self.core.format()
        return {name: array[0] for name, array in shown.items()} if isinstance(shown, dict) \
            else shown[0]

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """(height, width, 3) uint8: truth, estimate, its standard deviation, electrodes; None
        without a mode."""
        return self.core.draw(0) if can_render(self) else None

    def require_reset(self, caller: str) -> None:
        """Raise ``ResetNeeded`` before the first episode."""
        if self._step == 0:
            raise gym.error.ResetNeeded(f"call reset() before {caller}")


class EpisodeVectorEnv(gym.vector.VectorEnv[Any, np.ndarray, np.ndarray]):
    """Environments whose episodes have the same length, so that they begin and end together.

    Observations are bit-identical to ``SyncVectorEnv`` over the scalar environment:
    ``reset(seed=s)`` begins episode s + k in environment k, and the step after an episode's end
    begins the next one (``NEXT_STEP``). A growing sampler of training episodes (``episodes`` None)
    counts the resets of all environments together; in ``SyncVectorEnv`` each counts separately.
    """

    metadata = {"render_modes": RENDER_MODES, "render_fps": 8,  # noqa: RUF012
                "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(self, make_core: Callable[[], EpisodeCore], num_envs: int, episodes: int | None,
                 split: str, render_mode: str | None, max_episode_steps: int | None,
                 threads: int = 1) -> None:
        self.render_mode = check_render_mode(render_mode)
        self.num_envs = _check.integer("num_envs", num_envs, low=1)
        self.pool = EpisodeSampler(episodes, split)
        """episodes of unseeded resets"""
        self._threads = _check.integer("threads", threads, low=1)
        core = make_core()
        if max_episode_steps not in (None, core.length):       # gymnasium passes the spec's value
            raise ValueError("max_episode_steps must be None or the steps of an episode, "
                             f"{core.length}, got {max_episode_steps!r}")
        size = int(min(core.max_batch, -(-num_envs // threads)))
        self._parts = [slice(first, first + size) for first in range(0, num_envs, size)]
        self.cores: list[Any] = [copy(core) for _ in self._parts]
        self.world: World = core.world
        self.single_observation_space = core.observation_space
        self.single_action_space = core.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._randoms: list[np.random.Generator | None] = [None] * num_envs
        self._step = 0

    def render(self) -> tuple[np.ndarray, ...] | None:  # type: ignore[override]
        """Draw each episode as `EpisodeEnv.render` does; None without a mode."""
        if not can_render(self):
            return None
        return tuple(core.draw(b) for core in self.cores for b in range(len(core.seeds)))

    @property
    def seeds(self) -> tuple[int, ...]:
        """Episodes in progress."""
        return tuple(seed for core in self.cores for seed in core.seeds)

    def reset(self, *, seed: int | list[int | None] | None = None,
              options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin the episodes seed, seed + 1, …, or a list of seeds, or random ones of the split."""
        if options:
            raise ValueError("options must be None or empty, since all environments begin and end "
                             f"together; got {options!r}")
        seeds = self._seeds(seed)
        if any(one is not None for one in seeds):
            self.pool.reset()
        chosen = []
        for k, one in enumerate(seeds):
            random = self._randoms[k]
            if one is not None or random is None:
                self._randoms[k] = random = seeding.np_random(one)[0]
            chosen.append(self.pool.sample_seed(random) if one is None else one)
        warn_test_seeds(chosen)
        for number in chosen:
            self.pool.ensure_simulated(self.world, number)
        for core, part in zip(self.cores, self._parts, strict=True):
            core.reset(chosen[part])
        self._step = 1
        return _joined([core.format() for core in self.cores]), self._info()

    def _seeds(self, seed: int | list[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if not isinstance(seed, (list, tuple, np.ndarray)):
            first = _check.integer("seed", seed, low=0)
            return [first + k for k in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"seed must be an integer or a list of {self.num_envs}, "
                             f"got {len(seed)} entries")
        return [None if one is None else _check.integer("seed", one, low=0) for one in seed]

    def step(self, actions: np.ndarray,
             ) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step each environment; after an episode's end begin a new one, for any actions."""
        if self._step == 0:
            raise gym.error.ResetNeeded("call reset() before step()")
        none_ended = np.zeros(self.num_envs, dtype=bool)
        if self._step > self.cores[0].length:
            observation, info = self.reset()
            return observation, np.zeros(self.num_envs), none_ended, none_ended.copy(), info
        checked = self.cores[0].check(actions, self.action_space)

        def advance(core: EpisodeCore, part: slice) -> tuple[np.ndarray, Any]:
            return core.act(checked[part]), core.format()

        if self._threads == 1:
            done = list(map(advance, self.cores, self._parts))
        else:
            with ThreadPoolExecutor(self._threads) as executor:
                done = list(executor.map(advance, self.cores, self._parts))
        self._step += 1
        ended = np.full(self.num_envs, self._step > self.cores[0].length)
        rewards, shown = zip(*done, strict=True)
        return _joined(shown), np.concatenate(rewards), ended, none_ended, self._info()

    def _info(self) -> dict[str, Any]:
        info = {"step": np.full(self.num_envs, self._step)}
        errors = np.concatenate([core.errors() for core in self.cores])
        if not np.isnan(errors).all():
            info["error"] = errors
        return info | {f"_{name}": np.ones(self.num_envs, dtype=bool) for name in info}


def _joined(shown: Sequence[Any]) -> Any:
    """Return the observations of several cores together."""
    if not isinstance(shown[0], dict):
        return np.concatenate(shown)
    return {name: np.concatenate([part[name] for part in shown]) for name in shown[0]}
