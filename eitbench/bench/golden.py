"""Golden files: expected values of a few episodes of each world and of each built-in method.

A version of a world or method changes with these values, not with the code. A world's file holds
values of its model, of two simulated episodes, and its environment's first observations; a method's
file holds scores and estimates in two short episodes and in one of full length. Tolerances allow
for differences between processors and BLAS kernels.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from threadpoolctl import threadpool_limits

from eitbench import _check
from eitbench._files import PACKAGE, write_atomically
from eitbench.bench import methods, runner, tracks
from eitbench.bench.methods import is_path, load_method
from eitbench.bench.scores import compute_scores, scores
from eitbench.data import episode_cache
from eitbench.data.episodes import Episode, simulate_batch
from eitbench.data.seeds import format_seed, parse_seeds
from eitbench.estimation import best_homogeneous
from eitbench.worlds.registry import entry
from eitbench.worlds.task import make_task
from eitbench.worlds.world import World

WORLD_FOLDER = PACKAGE / "worlds" / "golden"
METHOD_FOLDER = methods.baseline_folder() / "golden"
FIRST_STEPS = 24
"""Number of simulated steps of a shortened episode; they include the first scored steps."""
WORLD_EPISODES = {"train:0": FIRST_STEPS, "dev:0": None}
"""Seed -> number of simulated steps of a world's golden episode; None: the whole episode."""
OBSERVATION_SEEDS = ("train:0", "dev:0", "dev:1")
SHORT_KWARGS = {"world": {"schedule": {"scored_steps": 4}}}
"""Arguments of a short episode of any environment."""
RTOL_FLOAT64, RTOL_FLOAT32 = 1e-6, 1e-4
"""Relative tolerances. The reduced filter and stored load vectors are in single precision."""


# -- files ----------------------------------------------------------------------------------------


def golden_methods() -> dict[str, str]:
    """Map the name of each method's golden file to the method: a name, or an agent's path."""
    agents = {methods.golden_name(Path(path)): path
              for id in tracks.ids("injection") for path in reversed(methods.builtin_agents(id))}
    return {name: name for track in tracks.TRACKS
            for name in methods.builtin_methods(track)} | agents


def golden_path(name: str) -> Path:
    """Return the path of the golden file of a built-in id or method."""
    folder = WORLD_FOLDER if name in tracks.builtin_ids() else METHOD_FOLDER
    return folder / f"{name.replace('/', '-')}.json"


def read_golden(name: str) -> dict[str, Any] | None:
    """Read a golden file; None if it is missing, ``ValueError`` if it is damaged."""
    path = golden_path(name)
    try:
        return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None
    except ValueError as error:                                 # invalid JSON or UTF-8
        raise ValueError(f"golden file {path} is damaged: {error}") from None


def update(names: list[str], *, new_version: bool = False) -> Iterator[tuple[str, str, list[str]]]:
    """Compare built-in ids and methods (default: all) with their golden files, and write missing
    files. Yield name, status (``new``, ``same``, ``moved``, or the new version) and differences.

    With ``new_version``, a method's file whose numbers differ is rewritten with the next version
    number. No other file is changed. ``ValueError`` if a name is neither a built-in id nor a
    built-in method.
    """
    known = [*tracks.builtin_ids(), *golden_methods()]
    for name in names:
        _check.choice("each of names", name, known)
    for name in names or known:
        expected = read_golden(name)
        computed = compute(name, expected)
        moved = compare(name, computed, expected) if expected else []
        status = "moved" if moved else "same" if expected else "new"
        if moved and new_version and "method" in computed:
            computed["version"] += 1
            status = f"v{computed['version']}"
        if status not in ("same", "moved"):
            write_atomically(golden_path(name), f"{json.dumps(computed, indent=1)}\n".encode())
            methods.golden_version.cache_clear()
        yield name, status, moved


def compute(name: str, expected: dict[str, Any] | None) -> dict[str, Any]:
    """Compute the content of a golden file, for a method with the episodes of the ``expected``."""
    if name in tracks.builtin_ids():
        return world_golden(name, tuple(WORLD_EPISODES), OBSERVATION_SEEDS)
    method = golden_methods()[name]
    golden = expected or _new_golden(name, method)
    return golden | {"episodes": [_run_episode(episode, method) for episode in golden["episodes"]]}


def compare(name: str, computed: dict[str, Any], expected: dict[str, Any]) -> list[str]:
    """Return one sentence for each number of two contents of a golden file that differs, without
    scores of a method that the ``expected`` lacks."""
    if "method" not in expected:
        return [f"{name}: {sentence}" for sentence in differences(computed, expected)]
    found = []
    for old, new in zip(expected["episodes"], computed["episodes"], strict=True):
        known = new | {"scores": {score: new["scores"].get(score) for score in old["scores"]}}
        found += differences(known, old, expected["tolerance"],
                             f"{old['environment']} {old['seed']}")
    return found


def differences(computed: Any, expected: Any, tolerance: float = RTOL_FLOAT64,
                place: str = "") -> list[str]:
    """Describe each number of two golden files, decoded JSON, that differs by more than the
    tolerance relative to the largest number of its list; for observations it is `RTOL_FLOAT32`."""
    if isinstance(computed, dict) and isinstance(expected, dict):
        if computed.keys() != expected.keys():
            others = ", ".join(sorted(computed.keys() ^ expected.keys()))
            return [f"{place or 'the file'} has other names: {others}"]
        return [line for name in expected for line in differences(
            computed[name], expected[name], RTOL_FLOAT32 if name == "observations" else tolerance,
            f"{place}.{name}".lstrip("."))]
    if not (_is_numeric(computed) and _is_numeric(expected)):
        return [] if computed == expected else [f"{place} is {computed!r}, expected {expected!r}"]
    new, old = np.ravel(computed).astype(float), np.ravel(expected).astype(float)
    if len(new) != len(old):
        return [f"{place} has {len(new)} numbers, expected {len(old)}"]
    scale = np.abs(old).max(initial=0.0)
    off = np.abs(new - old)
    if (off <= tolerance * scale).all():                        # False for NaN too
        return []
    worst = int(np.nanargmax(off)) if np.isfinite(off).any() else 0
    return [f"{place} differs by {off[worst] / (scale or 1.0):.2g} of its largest: number {worst} "
            f"is {new[worst]:.10g}, expected {old[worst]:.10g}"]


def _is_numeric(value: Any) -> bool:
    values = value if isinstance(value, list) else [value]
    return all(isinstance(each, int | float) for each in values)


# -- worlds ----------------------------------------------------------------------------------------


def world_golden(id: str, episodes: tuple[str, ...], seeds: tuple[str, ...]) -> dict[str, Any]:
    """Compute golden numbers of an id: of its world, and first observations with these seeds."""
    return round_numbers({"id": id, **world_numbers(entry(id).world, episodes), "observations": {
        seed: first_observations(id, seed) for seed in seeds}})


@lru_cache(maxsize=2)
def world_numbers(world: World, episodes: tuple[str, ...]) -> dict[str, Any]:
    """Compute numbers of a world: ``model`` (computed voltages in V, a transport step in mol/m³),
    and for each of ``episodes`` some entries of 𝓡 in Ω, noise draws, voltages in V, load vectors
    b_t, ∫(c − background)², ∫c², load vectors of the velocity, faults, ĉ_bh in mol/m³, and the mean
    relative error of that estimate."""
    return {"model": _model_numbers(world.truth_config),
            "episodes": {name: _episode_numbers(world, name) for name in episodes}}


def round_numbers(value: Any) -> Any:
    """Return numbers and arrays, in nested dicts, as lists of numbers with ten digits."""
    if isinstance(value, dict):
        return {name: round_numbers(inner) for name, inner in value.items()}
    if isinstance(value, str):
        return value
    return [float(f"{number:.10g}") for number in np.ravel(value)]


def _sample(values: np.ndarray) -> np.ndarray:
    """Return four entries of (n,) and the mean of all."""
    n = len(values)
    return np.append(values[[0, n // 3, n // 2, n - 1]].astype(float), values.mean(dtype=float))


@lru_cache(maxsize=2)
def _model_numbers(world: World) -> dict[str, Any]:
    task = make_task(world)
    level = np.full(task.mesh.n_nodes, world.expected_concentration)
    wave = level * (1.0 + 0.2 * np.sin(np.arange(task.mesh.n_nodes)))
    moved = task.transport.step(wave, world.expected_concentration,
                                1.1 * world.expected_concentration)
    return {"homogeneous": task.observation.voltages(level, world.currents[:1])[0],
            "wave": task.observation.voltages(wave, world.currents[:1])[0],
            "step": _sample(moved)}


@lru_cache(maxsize=4)
def _episode(world: World, name: str) -> Episode:
    """Simulate a golden episode of a world's `World.truth_config`, which variants share."""
    n_steps = min(WORLD_EPISODES[name] or world.n_steps, world.n_steps)
    (episode,) = simulate_batch(world, parse_seeds(name), False, n_steps)
    return episode


def _episode_numbers(world: World, name: str) -> dict[str, Any]:
    (seed,) = parse_seeds(name)
    episode = _episode(world.truth_config, name)
    task = make_task(world.truth_config)
    L = world.vessel.n_electrodes
    entries = episode_cache.build_cached_episode(world, episode)
    moments, deviations, squares = episode_cache.integrals(world, entries)
    voltages = episode_cache.cycle_voltages(world, seed, entries)
    sound = episode_cache.cycle_voltages(world.fault_free, seed, entries)[:world.calibration]
    cycle = world.currents[np.arange(world.calibration) % len(world.currents)]
    homogeneous = best_homogeneous(task.observation, world.noise, sound, cycle,
                                   world.expected_concentration)
    level = np.full(task.mesh.n_nodes, homogeneous - world.background)
    mass = episode_cache.score_mass(world)
    errors = [float(episode_cache.step_error(mass, level, moments[k], deviations[k], squares[k]))
              for k in range(world.warm_up, len(entries))]
    faults = episode_cache.instrument_faults(world, seed)
    n = len(entries)
    steps = [0, 8, min(FIRST_STEPS, n) - 1] + [n // 2, n - 1] * (n > FIRST_STEPS)
    numbers = {
        "seed": format_seed(seed),
        "resistance": entries["transfer_resistance"][steps][:, [0, 0, 1, L // 2],
                                                            [1, L // 2, L - 1, L // 2]],
        "noise": entries["noise"][steps][:, [0, L - 1]],
        # NaN where the instrument does not measure
        "voltages": np.nan_to_num(voltages[steps][:, [0, L // 2, L - 1]]),
        "moment": np.array([_sample(moments[k]) for k in steps]), "deviation": deviations[steps],
        "mean_moment": _sample(moments.mean(axis=0, dtype=float)),
        "square": squares[steps], "homogeneous": homogeneous, "floor": float(np.mean(errors)),
        "broken_from": faults.open_circuit_from, "loose": faults.resistance}
    if world.velocity_model is not None:
        flow = entries["velocity_moment"][steps]
        numbers["velocity"] = np.column_stack([flow, entries["velocity_square"][steps]])
    return numbers


def first_observations(id: str, name: str) -> dict[str, Any]:
    """Return some entries of the first observations of an environment, one from `reset` and two
    from `step`, and the rewards."""
    env = gym.make(id)
    observation, _ = env.reset(seed=parse_seeds(name)[0])
    numbers: dict[str, Any] = {"0": _observation_sample(observation)}
    rewards = []
    for k in (1, 2):
        observation, reward, _, _, _ = env.step(_fixed_action(env, k))
        numbers[str(k)] = _observation_sample(observation)
        rewards.append(float(reward))
    env.close()
    return numbers | {"rewards": rewards}


def _observation_sample(observation: Any) -> dict[str, Any]:
    parts = observation if isinstance(observation, dict) else {"": observation}
    return {key: _sample(np.ravel(value)) for key, value in parts.items()}


def _fixed_action(env: gym.Env, k: int) -> Any:
    """Return an action that depends on the step and the action space only."""
    space: Any = env.action_space
    if isinstance(space, gym.spaces.MultiDiscrete):
        return (7 * k + np.arange(len(space.nvec))) % space.nvec
    if isinstance(space, gym.spaces.Discrete):
        return 7 * k % int(space.n)
    if getattr(env.unwrapped, "task", None) is None:            # currents
        return np.cos(k * np.arange(space.shape[0])).astype(space.dtype)
    task: Any = env.unwrapped
    return np.resize(task.task.expected_concentration, space.shape).astype(space.dtype)


# -- methods ---------------------------------------------------------------------------------------


def _new_golden(name: str, method: str) -> dict[str, Any]:
    """Return a method's golden file without numbers: episodes of its first environment."""
    id = next((id for id in tracks.builtin_ids() if _is_compatible(method, id)), None)
    if id is None:
        raise ValueError(f"method {name} must be compatible with a built-in environment")
    return {"method": name, "version": 1, "tolerance": RTOL_FLOAT64, "episodes": [
        {"environment": id, "kwargs": kwargs, "seed": seed} for kwargs, seed in (
            (SHORT_KWARGS, "dev:0"), (SHORT_KWARGS, "dev:1"), ({}, "dev:0"))]}


def _is_compatible(method: str, id: str) -> bool:
    asked = tracks.Environment(id, json.dumps(SHORT_KWARGS))
    if is_path(method):
        return Path(method).parents[2].name == id.replace("/", "-")
    return method in methods.builtin_methods(asked.track) and runner.is_compatible(
        load_method(method, asked.track), runner.cached_environment(asked))


def _run_episode(episode: dict[str, Any], method: str) -> dict[str, Any]:
    """Rerun an episode of a method's golden file, and return it with the new numbers.

    ``scores`` are the finite scores except times. For an estimator, ``mean`` and ``last`` are
    entries of its mean and last estimate in mol/m³; for a policy, ``injections`` are the source and
    sink electrodes of each step. ``ValueError`` if the method is incompatible.
    """
    asked = tracks.Environment(episode["environment"], json.dumps(episode["kwargs"]))
    (seed,) = parse_seeds(episode["seed"])
    with threadpool_limits(1):                                  # as for records
        played = runner.run_method(asked, load_method(method, asked.track), seed)
    numbers = compute_scores(asked.track, played.outcome)
    made = {key: episode[key] for key in ("environment", "kwargs", "seed")} | {
        "scores": {score: value for score, value in numbers.items()
                   if value is not None and math.isfinite(value) and scores()[score].deterministic}}
    if not played.fields:
        return made | {"injections": [
            [int(step.argmax()), int(step.argmin())] if step.any() else []
            for step in played.currents]}
    means = played.fields["mean"].astype(float)
    states = means[np.isfinite(means).all(axis=1)]
    nodes = np.linspace(0, means.shape[1] - 1, 7).astype(int)[1:-1]         # five inner ones
    return made | {"mean": states[:, nodes].mean(axis=0).tolist(),
                   "last": states[-1, nodes].tolist()}
