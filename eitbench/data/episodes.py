"""`simulate(scenario, seed) -> Episode`: the truth, computed once and kept in a cache on disk.

Currents do not move the fluid, so an episode's whole measurement content is one transfer-resistance matrix a step.
"""

from __future__ import annotations

import hashlib
import inspect
import io
import json
import os
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy
from tqdm import tqdm

from eitbench import _check
from eitbench._code import code_digest, package_files
from eitbench._files import write_atomically
from eitbench.worlds.base import Discretisation, Randomness, Scenario

CACHE_VARIABLE = "EITBENCH_CACHE"


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

    def voltages(self, step: int, currents: np.ndarray, scenario: Scenario) -> np.ndarray:
        """Noisy voltages (L,) in V when ``currents`` (L,) in A (A/m in 2D) are injected at step 1 … T."""
        clean = self.transfer_resistance[step - 1] @ currents
        return clean + scenario.noise.std(clean) * self.noise[step - 1]


def simulate(scenario: Scenario, seed: int, *, cache: bool = True, progress: bool = True) -> Episode:
    """The episode of ``scenario`` with this seed, from the cache if it is there.

    Parameters
    ----------
    scenario : Scenario
    seed : int
        ≥ 0; see `eitbench.data.seeds` for the public ranges.
    cache : bool
        Read from and write to the cache folder ($EITBENCH_CACHE, by default in the user's cache folder). A file that
        is damaged or of another scenario or seed is replaced; files of other versions stay beside it.
    progress : bool
        Show a progress bar, on a terminal only.
    """
    seed = _check.integer("seed", seed, low=0)
    if not cache:
        return _simulate(scenario, seed, progress)
    whole = _identity(scenario, seed)
    path = folder(scenario) / f"{seed}.truth.npz"
    episode = _load(path, whole)
    if episode is None:
        episode = _simulate(scenario, seed, progress)
        try:
            _store(path, whole, episode)
        except OSError as error:
            warn_not_kept(path.parent, error)
    return episode


@lru_cache(maxsize=4)
def truth_discretisation(scenario: Scenario) -> Discretisation:
    """``scenario.truth()``, built once a process."""
    return scenario.truth()


def _simulate(scenario: Scenario, seed: int, progress: bool) -> Episode:
    return next(simulate_together(scenario, [seed], progress))


def simulate_together(scenario: Scenario, seeds: Sequence[int], progress: bool = True) -> Iterator[Episode]:
    """The episodes of several seeds, bit for bit as `simulate` gives them and without the cache.

    Eight concentrations in one flow are carried on together in the time of two, and eight conductivities are solved
    for at once.
    """
    truth = truth_discretisation(scenario)
    label = f"simulating {type(scenario).__name__}, seed {', '.join(map(str, seeds))}"
    with tqdm(total=(scenario.lead_in + 2 * scenario.n_steps) * len(seeds), desc=label, unit="step", leave=False,
              disable=None if progress else True) as bar:
        episodes = [randomness(seed) for seed in seeds]
        for history, random in zip(scenario.evolve(episodes, truth, bar.update), episodes, strict=True):
            noise = random.noise.standard_normal((scenario.n_steps, truth.observation.cem.n_electrodes))
            resistance = truth.observation.transfer_resistance(history.concentration[1:])
            bar.update(scenario.n_steps)
            yield Episode(history.concentration.astype(np.float32), resistance, noise, history.velocity)


def randomness(seed: int) -> Randomness:
    """The streams of the episode with this seed, from their beginning."""
    return Randomness(*map(np.random.default_rng, np.random.SeedSequence(seed).spawn(3)))


# -- cache ------------------------------------------------------------------------------------------------------------


def cache_folder() -> Path:
    """Where episodes are kept: $EITBENCH_CACHE, else $XDG_CACHE_HOME/eitbench, else ~/.cache/eitbench."""
    if os.environ.get(CACHE_VARIABLE):
        return Path(os.environ[CACHE_VARIABLE])
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "eitbench"


def folder(scenario: Scenario) -> Path:
    """Where the episodes of a scenario, as this version simulates them, are kept."""
    return cache_folder() / f"{type(scenario).__name__}-{_version(scenario)}"


@lru_cache(maxsize=64)
def _version(scenario: Scenario) -> str:
    return _digest(json.dumps(identity(scenario), sort_keys=True).encode())[:16]


def warn_not_kept(place: Path, error: OSError) -> None:
    """Say once that the cache cannot be written."""
    warnings.warn(f"episodes cannot be kept in {place} ({error}) and will be simulated again; "
                  f"${CACHE_VARIABLE} names another folder", stacklevel=3)


def identity(scenario: Scenario) -> dict[str, Any]:
    """All that the numbers depend on but the seed: scenario, the code that simulates, and the libraries beneath it."""
    kind = type(scenario)
    return {"scenario": f"{kind.__module__}.{kind.__qualname__}", "fields": asdict(scenario),  # type: ignore
            "code": _code_digest(), "world": _source_digest(kind),
            "factorisation": f"numba {version('numba')}",
            "numpy": np.__version__, "scipy": scipy.__version__, "scikit-fem": version("scikit-fem")}


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _identity(scenario: Scenario, seed: int) -> str:
    return json.dumps(identity(scenario) | {"seed": seed}, sort_keys=True)


@lru_cache(maxsize=1)
def _code_digest() -> str:
    return code_digest(package_files("numerics/*.py", "physics/*.py", "worlds/base.py", "worlds/carried.py",
                                     "data/recordings.py", "data/episodes.py"))


@lru_cache(maxsize=64)
def _source_digest(kind: type) -> str:
    """Of the files of a scenario and of those it descends from; a class typed into a session has none.

    Other scenarios' files may change, or come, without a simulated episode being lost.
    """
    files = []
    for part in kind.__mro__:
        if part.__module__ not in ("builtins", "typing"):
            try:
                files.append(Path(inspect.getfile(part)))
            except (OSError, TypeError):
                continue
    return code_digest(dict.fromkeys(files))


def _store(path: Path, whole: str, episode: Episode) -> None:
    """Written beside its place and moved there, so that a reader sees a whole file or none."""
    content = io.BytesIO()
    np.savez_compressed(content, identity=whole, checksum=_checksum(episode), **episode._asdict())
    write_atomically(path, content.getvalue())


def _load(path: Path, whole: str) -> Episode | None:
    try:
        with np.load(path, allow_pickle=False) as stored:
            if str(stored["identity"]) != whole:
                return None
            arrays: dict[str, Any] = {name: stored[name] for name in Episode._fields}
            episode = Episode(**arrays)
            return episode if str(stored["checksum"]) == _checksum(episode) else None
    except Exception:       # a damaged archive may raise anything: zlib.error, NotImplementedError, RuntimeError, …
        return None


def _checksum(episode: Episode) -> str:
    return _digest(b"".join(np.ascontiguousarray(array).tobytes() for array in episode))
