"""`simulate(world, seed) -> Episode`: the truth, computed once and kept in a cache on disk.

Currents do not move the fluid, so an episode's whole measurement content is one transfer-resistance
matrix a step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, wraps
from typing import Any, NamedTuple, TypeVar

import numpy as np
from tqdm import tqdm

from eitbench import _check
from eitbench._notice import Wait
from eitbench.data.cache import Key, cached, episode_key
from eitbench.worlds.instrument import Faults
from eitbench.worlds.random_streams import episode_streams
from eitbench.worlds.world import Discretisation, World

Made = TypeVar("Made")
PRESIMULATE_HINT = "`eitbench bank --env ID --seeds train:0-99` makes episodes beforehand"
"""What to say to those who wait for one."""


class Episode(NamedTuple):
    """What happened, t = 0 … T. The truth: no estimator or policy ever holds one."""

    concentration: np.ndarray
    """(T + 1, n_truth) float32 nodal concentration in mol/m³ on the truth's CD mesh."""
    transfer_resistance: np.ndarray
    """(T, L, L) 𝓡 at t = 1 … T in Ω (Ω·m in 2D)."""
    noise: np.ndarray
    """(T, L) standard normal draws, one a reading."""
    velocity: np.ndarray
    """(T, p) m/s at `VelocityModel.points`, t = 1 … T; p = 0 where nobody is asked for the flow."""

    def voltages(self, step: int, currents: np.ndarray, world: World) -> np.ndarray:
        """Noisy voltages (L,) in V of a sound instrument when ``currents`` (L,) in A (A/m in 2D)
        are injected at step 1 … T."""
        k = slice(step - 1, step)
        return world.instrument.measure(Faults.none(len(currents)), step,
                                        self.transfer_resistance[k], currents[None],
                                        self.noise[k])[0]


def simulate(world: World, seed: int, *, cache: bool = True, progress: bool = True) -> Episode:
    """Return the episode of ``world`` with this seed, from the cache or simulated.

    Parameters
    ----------
    world : World
    seed : int
        ≥ 0; see `eitbench.data.seeds` for the public ranges.
    cache : bool
        Read from and write to the cache folder ($EITBENCH_CACHE, by default in the user's cache
        folder).
    progress : bool
        Show a progress bar, on a terminal only, and report what takes longer than two seconds.
    """
    seed = _check.integer("seed", seed, low=0)

    def build() -> dict[str, Any]:
        return next(simulate_batch(world, [seed], progress))._asdict()

    if not cache:
        return Episode(**build())
    return Episode(**cached(_key(world, seed), build))


def is_simulated(world: World, seed: int) -> bool:
    """Return whether the cache holds the truth."""
    return _key(world, seed).path.is_file()


def _key(world: World, seed: int) -> Key:
    return episode_key(world, f"{seed}.truth")


def cache_per_truth(many: int) -> Callable[[Callable[[World], Made]], Callable[[World], Made]]:
    """Decorate a function of a world: it runs once a process for all worlds with the same
    `World.truth_config`, and results of ``many`` are kept."""
    def decorated(make: Callable[[World], Made]) -> Callable[[World], Made]:
        kept = lru_cache(maxsize=many)(make)
        return wraps(kept)(lambda world: kept(world.truth_config))

    return decorated


@cache_per_truth(4)
def cached_truth_model(world: World) -> Discretisation:
    """``world.truth_model()``."""
    return world.truth_model()


def simulate_batch(world: World, seeds: Sequence[int], progress: bool = True,
                      last: int | None = None) -> Iterator[Episode]:
    """Simulate several seeds, with the bits of `simulate`, up to the state ``last`` (default: all).

    In one flow eight episodes take the time of two.
    """
    truth = cached_truth_model(world)
    label = f"simulating {world.name}, seed {', '.join(map(str, seeds))}"
    electrodes = truth.observation.cem.n_electrodes
    steps = world.n_steps if last is None else last
    total = (world.spin_up_steps + 2 * steps) * len(seeds)
    wait = Wait(label, total, PRESIMULATE_HINT)
    with tqdm(total=total, desc=label, unit="step", leave=False,
              disable=None if progress else True) as bar:
        def tick(steps: int) -> None:
            bar.update(steps)
            if progress:
                wait.tick(steps)

        streams = [episode_streams(seed) for seed in seeds]
        for history, random in zip(world.evolve(streams, truth, tick, steps), streams, strict=True):
            noise = random.noise.standard_normal((world.n_steps, electrodes))[:steps]
            observation = world.true_observation(truth, random.contacts)
            resistance = observation.transfer_resistance(history.concentration[1:])
            tick(steps)
            concentration = history.concentration.astype(np.float32)
            yield Episode(concentration, resistance, noise, history.velocity)
