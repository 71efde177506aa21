"""Find, load and play injection policies: one Python file each, with a class `Policy`."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from eitbench.bench.baselines import (
    baseline_folder,
    file_of,
    installed_methods,
    is_privileged,
    load_module,
    parameters_of,
    role_of,
    title_of,
    version_of,
)
from eitbench.bench.scores import Outcome
from eitbench.bench.tracks import Environment, check_track
from eitbench.data.episodes import simulate, truth_discretisation
from eitbench.data.regions import region_operators
from eitbench.envs.injection import InjectionEnv
from eitbench.estimation.onboard.operator import Innovation
from eitbench.estimation.onboard.rules import Rules
from eitbench.worlds.registry import entry
from eitbench.worlds.streams import randomness
from eitbench.worlds.world import World

if TYPE_CHECKING:
    import pandas as pd

LOADERS = "eitbench.loaders"
"""Entry points that load a policy from another kind of file: named by its suffix, called with path
and content."""


class PolicyFile(NamedTuple):
    """A loaded policy file."""

    name: str
    """Name of the file without its suffix."""
    title: str
    """First line of its docstring, up to a colon, bracket or full stop."""
    path: Path
    sha256: str
    privileged: bool    # shown the truth: a bound for the others, not one of them
    parameters: dict[str, Any]
    policy: Callable[..., Any]
    """Policy(rules, random), if privileged Policy(rules, random, core), with act(observation) ->
    action."""
    role: str | None = None
    """One of `ROLES`, as of baselines."""

    @property
    def version(self) -> str:
        """As `version_of`."""
        return version_of(self.path, self.sha256)

    def suits(self, rules: Rules) -> bool:
        """Whether it can play in this world; a policy without a word on that plays in all."""
        judge = getattr(self.policy, "suits", None)
        return judge is None or bool(judge(rules))


class Injected(NamedTuple):
    """An episode that a policy has played."""

    outcome: Outcome
    currents: np.ndarray
    """(steps, L) A (A/m in 2D) of each of its injections"""


class _Claim(NamedTuple):
    """What the filter inside says of a scored state."""

    t: int
    error: float
    mean: np.ndarray
    """(n,) mol/m³"""
    std: np.ndarray
    """(n,) mol/m³"""
    innovation: Innovation | None


def policy_folder() -> Path:
    """Where our own policies lie."""
    return baseline_folder() / "injection"


def own_policies() -> list[str]:
    """Names of our own policies."""
    return sorted(path.stem for path in policy_folder().glob("*.py"))


def own_agents(env_id: str) -> list[str]:
    """Paths of our own trained agents for an environment:
    ``baselines/checkpoints/ENV/ALGO/seedK/model.zip``; none without the extra ``rl``."""
    if not find_spec("stable_baselines3"):
        return []
    folder = baseline_folder() / "checkpoints" / env_id.replace("/", "-")
    return [str(path) for path in sorted(folder.glob("*/seed*/model.zip"))]


def find_policy(name: str) -> Path:
    """The file of a policy that `load_policy` loads; ``ValueError`` if there is none, or it has the
    name of another."""
    path = file_of(name, policy_folder())
    if not path.is_file():
        raise ValueError("policy must be the path of a .py file or of an agent's model.zip, or one of "
                         f"{', '.join([*own_policies(), *installed_methods()])}; got {name!r}")
    if path.stem in own_policies() and not path.samefile(policy_folder() / path.name):
        raise ValueError(f"policy {path} has the name of one of ours, under which results are kept; rename it")
    return path


def load_policy(name: str) -> PolicyFile:
    """Load one of our policies by name, anybody's by the path of its file, or a trained agent by
    that of its model.zip.

    Raises
    ------
    ValueError
        If there is no such policy, its file has no class `Policy` with an `act` method, or an
        agent's file is not the one that was left by training.
    """
    path = find_policy(name)
    return _load(path, path.read_bytes())


@lru_cache(maxsize=64)
def _load(path: Path, source: bytes) -> PolicyFile:
    """The file with this content, executed once a process."""
    kinds = {f".{point.name}": point for point in entry_points(group=LOADERS)}
    if path.suffix in kinds:
        name, title, agent, parameters = kinds[path.suffix].load()(path, source)
        return PolicyFile(name, title, path, hashlib.sha256(source).hexdigest(), False, parameters, agent)
    module = load_module("policy", path, source)
    policy = getattr(module, "Policy", None)
    if not isinstance(policy, type) or not callable(getattr(policy, "act", None)):
        raise ValueError(f"policy {path} must define a class Policy with a method act(observation)")
    who = f"policy {path}: Policy"
    return PolicyFile(path.stem, title_of(module, path), path, hashlib.sha256(source).hexdigest(),
                      is_privileged(who, policy), parameters_of(who, policy), policy, role_of(who, policy))


def play(env_id: str, kwargs: dict[str, Any], policy: str | PolicyFile, seed: int,
         estimator: str = "full") -> Injected:
    """Play one episode.

    Parameters
    ----------
    env_id, kwargs
        An environment that asks for injections, and arguments for it.
    policy : str or PolicyFile
        Name or path, or what was loaded.
    estimator : "full" or "reduced"
        The exact filter, for scores, or the one of training.

    Raises
    ------
    ValueError
        If there is no such environment or policy, or the policy does not suit it or acts wrongly.
    """
    env = environment(env_id, json.dumps(kwargs), estimator)
    loaded = policy if isinstance(policy, PolicyFile) else load_policy(policy)
    world, seconds = env.core.world, 0.0
    currents, claims = list[np.ndarray](), list[_Claim]()
    # the clock of `inject` stands still while the filter is asked
    for t, observation, elapsed in inject(env, loaded, seed):
        seconds += elapsed
        currents.append(observation["currents"])
        if (error := env.error) is not None:
            means, stds = env.core.estimate()
            claims.append(_Claim(t, error, means[0], stds[0], env.core.innovations()[0]))
    spent = sum(bool(each.any()) for each in currents)
    states, errors, means, stds, innovations = zip(*claims, strict=True)
    interpolation, mass = region_operators(world)
    truth = simulate(world, seed, progress=False).concentration[list(states)].astype(float)
    used = [innovation for innovation in innovations if innovation is not None]
    both = [each.value for each in used], [each.covariance for each in used]
    outcome = Outcome(
        world, seconds / env.core.length, np.array(errors), spent,
        mean=(interpolation @ np.array(means).T).T, truth=truth, mass=mass,
        points=truth_discretisation(world).transport.mesh.points,
        innovations=both if used else None, std=(interpolation @ np.array(stds).T).T)
    return Injected(outcome, np.array(currents))


def inject(env: InjectionEnv, loaded: PolicyFile, seed: int) -> Iterator[tuple[int, dict[str, np.ndarray], float]]:
    """(t of the state now seen, observation, seconds the policy took) after each of its injections
    in one episode, the first with what it took to prepare; errors as `play`."""
    if not loaded.suits(env.rules):
        raise ValueError(f"policy {loaded.name} does not suit {env.spec.id if env.spec else env}")
    observation, done, t = env.reset(seed=seed)[0], False, env.core.first
    # A generator knows what it was seeded with, so the policy's is seeded with a number that says
    # nothing of the episode.
    random = np.random.default_rng(int(randomness(seed).policy.integers(2**63)))
    begin = time.perf_counter()
    player = loaded.policy(env.rules, random, *[env.core] * loaded.privileged)
    while not done:
        action = player.act(observation)
        seconds = time.perf_counter() - begin
        observation, _, done, _, _ = env.step(action)
        t += 1
        yield t, observation, seconds
        begin = time.perf_counter()


def environment(env_id: str, kwargs: str, estimator: str = "full") -> InjectionEnv:
    """Made once a process, so that its models are shared by all episodes; ``kwargs`` are JSON."""
    check_track(env_id, "injection")
    return _made(Environment(env_id, kwargs), estimator, entry(env_id).world)


@lru_cache(maxsize=4)
def _made(asked: Environment, estimator: str, world: World) -> InjectionEnv:
    """Whose ``world`` is that of the id: another process may have told this one of another."""
    return cast(InjectionEnv, asked.make(estimator=estimator))


def adaptivity_gap(table: pd.DataFrame, open_loop: Sequence[str]) -> tuple[float, float, float]:
    """(best open-loop − clairvoyant) / (random − clairvoyant), mean errors each, with its 95 %
    bootstrap interval.

    Parameters
    ----------
    table : DataFrame
        Columns policy, seed and error, with the policies clairvoyant, random_pair and
        ``open_loop``, all on the same episodes.
    open_loop : sequence of str
        Names; the one of them with the least mean error counts.

    Returns
    -------
    gap, low, high
    """
    errors = table.pivot_table(index="seed", columns="policy", values="error")
    needed = ["clairvoyant", "random_pair", *open_loop]
    if not open_loop or set(needed) - set(errors) or errors[needed].isna().to_numpy().any():
        raise ValueError("table must hold clairvoyant, random_pair and some open-loop policies on the same episodes; "
                         f"got {', '.join(map(str, errors))}")
    best = errors[list(open_loop)].mean().idxmin()
    three = errors[[best, "random_pair", "clairvoyant"]].to_numpy()
    drawn = np.random.default_rng(0).integers(len(three), size=(10_000, len(three)))
    means = np.concatenate([three.mean(axis=0)[None], three[drawn].mean(axis=1)])
    gaps = (means[:, 0] - means[:, 2]) / (means[:, 1] - means[:, 2])
    low, high = np.percentile(gaps[1:], [2.5, 97.5])
    return float(gaps[0]), float(low), float(high)
