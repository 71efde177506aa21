"""Simulation of episodes: `simulate(world, seed) -> Episode`, with a cache on disk.

Currents do not influence the flow, so that one transfer-resistance matrix per step determines the
voltages of any injection.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, wraps
from typing import Any, NamedTuple, TypeVar

import numpy as np
from tqdm import tqdm

from eitbench import _check
from eitbench._notice import SlowTaskNotice
from eitbench.data.cache import cached, episode_key
from eitbench.worlds.random_streams import episode_streams
from eitbench.worlds.world import Discretisation, World

Made = TypeVar("Made")
PRESIMULATE_HINT = "`eitbench bank --env ID --seeds train:0-99` simulates episodes in advance"
"""Advice in messages about long simulations."""


class Episode(NamedTuple):
    """Ground truth of an episode, t = 0 … T; estimators and policies have no access to it."""

    concentration: np.ndarray
    """(T + 1, n_truth) float32 nodal concentration in mol/m³ on the truth's transport mesh."""
    transfer_resistance: np.ndarray
    """(T, L, L) 𝓡 at t = 1 … T in Ω (Ω·m in 2D)."""
    noise: np.ndarray
    """(T, L) standard normal draws, one for each measurement."""
    velocity: np.ndarray
    """(T, p) m/s at `VelocityModel.points`, t = 1 … T; p = 0 if the task does not request it."""


def simulate(world: World, seed: int, *, cache: bool = True, progress: bool = True) -> Episode:
    """Return the episode of ``world`` with this seed ≥ 0 (see `eitbench.data.seeds`), simulated, or
    with ``cache`` from the cache folder ($EITBENCH_CACHE, by default in the user's cache folder).

    With ``progress``, show a progress bar, on a terminal only, and report a simulation of over two
    seconds.
    """
    seed = _check.integer("seed", seed, low=0)

    def build() -> dict[str, Any]:
        return next(simulate_batch(world, [seed], progress))._asdict()

    if not cache:
        return Episode(**build())
    return Episode(**cached(episode_key(world, f"{seed}.truth"), build))


def cache_per_truth(function: Callable[[World], Made]) -> Callable[[World], Made]:
    """Cache a function of a world by `World.truth_config`, for four of them."""
    cached_function = lru_cache(maxsize=4)(function)
    return wraps(cached_function)(lambda world: cached_function(world.truth_config))


@cache_per_truth
def cached_truth_model(world: World) -> Discretisation:
    """Return ``world.truth_model()``, cached."""
    return world.truth_model()


def n_solutions(world: World, steps: int) -> int:
    """Return the number of linear systems that are solved for an episode up to the state ``steps``:
    one for each time step since the spin-up began, one for the potential of each state."""
    return world.spin_up_steps + 2 * steps


def simulate_batch(world: World, seeds: Sequence[int], progress: bool = True,
                   last: int | None = None) -> Iterator[Episode]:
    """Simulate several seeds up to the state ``last`` (default: all), bit-identical to `simulate`;
    with a common flow eight episodes take the time of two."""
    truth = cached_truth_model(world)
    label = f"simulating {world.name}, seed {', '.join(map(str, seeds))}"
    electrodes = truth.observation.cem.n_electrodes
    spread = world.instrument.contact_impedance_spread
    steps = world.n_steps if last is None else last
    total = n_solutions(world, steps) * len(seeds)
    wait = SlowTaskNotice(label, total, PRESIMULATE_HINT)
    with tqdm(total=total, desc=label, unit="step", leave=False,
              disable=None if progress else True) as bar:
        def tick(steps: int) -> None:
            bar.update(steps)
            if progress:
                wait.tick(steps)

        streams = [episode_streams(seed) for seed in seeds]
        trajectories = world.target.evolve(world, streams, truth, tick, steps)
        for trajectory, random in zip(trajectories, streams, strict=True):
            noise = random.noise.standard_normal((world.n_steps, electrodes))[:steps]
            observation = truth.observation
            if spread:
                factor = random.contacts.uniform(1.0 - spread, 1.0 + spread, electrodes)
                observation = observation.with_contacts(factor * observation.cem.contact_impedance)
            resistance = observation.transfer_resistance(trajectory.concentration[1:])
            tick(steps)
            concentration = trajectory.concentration.astype(np.float32)
            yield Episode(concentration, resistance, noise, trajectory.velocity)
