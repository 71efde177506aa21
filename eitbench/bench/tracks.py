"""Registered environments: tracks, subtracks and default seeds, all derived from their ids."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from inspect import Parameter, signature
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator

from eitbench import _check
from eitbench.data.seeds import parse_seeds
from eitbench.worlds.registry import entries, entry

if TYPE_CHECKING:
    from eitbench.envs.estimation import EstimationEnv
    from eitbench.envs.injection import InjectionEnv

TRACKS = ("estimation", "injection")
"""Tasks: an estimate of every state, or the next injection."""
SUBTRACKS = {"estimation": ("filter", "fixed-lag", "smoothing"), "injection": ("injection",)}
"""Subtracks of each track; in estimation they differ in the lag of an estimate."""
ALL_SUBTRACKS = tuple(board for boards in SUBTRACKS.values() for board in boards)
CATEGORIES = ("filter", "fixed-lag", "smoothing", "stationary", "injection")
"""Groups of environments that are ranked together: subtracks, with stationary targets separate."""
NAIVE_BASELINES = {"estimation": "homogeneous", "injection": "random_pair"}
"""Naive baselines: they define a leaderboard's episodes and the zero of its skill score."""
ONBOARD_FILTERS = ("full", "reduced")
"""Filters inside an injection environment: the full one for scores, the reduced for training."""

MEASURED = "eitbench.envs.measured:case_env"
"""Entry point of the ids of measured cases."""
MEASURED_FILES = "eitbench-Measured-"
"""Prefix of the file names of their records."""
MEASURED_SEEDS = "test:0-4"
"""Seeds of runs on measurements, which differ in the withheld measurements."""
QUICK_IDS = ("eitbench/Pipe2D-v0", "eitbench/Pipe2DFixedLag-v0", "eitbench/Pipe2DSmoothing-v0")
"""Environments of the quick suite; the full suite has all of the track estimation."""
QUICK_SEEDS = "test:0-3"
RUN_KWARGS = {"estimation": {}, "injection": {"estimator": "full", "observation": "raw"}}
"""Default arguments of each track's environments in runs: the full filter and unscaled
observations. Registered ids have other defaults, for training."""


class Environment(NamedTuple):
    """A registered id with keyword arguments."""

    id: str
    kwargs: str = "{}"
    """JSON"""

    @property
    def overrides(self) -> dict[str, Any]:
        """Return the arguments that differ from the registered ones."""
        usual = {"world": {}} | registered_kwargs(self.id)
        return {key: value for key, value in json.loads(self.kwargs).items() if value is not None
                and (key not in usual or json.dumps(value) != json.dumps(usual[key]))}

    @property
    def name(self) -> str:
        """Return a name for folders, which depends on the arguments."""
        return environment_name(self.id, self.overrides)

    @property
    def track(self) -> str:
        """Return its track; errors as in `track_of`."""
        return track_of(self.id)

    @property
    def arguments(self) -> dict[str, Any]:
        """Return all arguments with which it is made, including defaults, but not the split of
        unseeded resets, which a run does not have."""
        defaults = {name: each.default for name, each in _parameters(self.id).items()
                    if each.default is not Parameter.empty and name != "split"}
        return (defaults | registered_kwargs(self.id) | RUN_KWARGS[self.track]
                | json.loads(self.kwargs))

    def make(self, **extra: Any) -> EstimationEnv | InjectionEnv:
        """Make the environment without wrappers; ``ValueError`` if an argument is invalid."""
        arguments = RUN_KWARGS[self.track] | json.loads(self.kwargs) | extra
        _check.choice("estimator", arguments.get("estimator", "full"), ONBOARD_FILTERS)
        made: Any = gym.make(self.id, disable_env_checker=True, **arguments).unwrapped
        return made


def _parameters(id: str) -> dict[str, Parameter]:
    """Return the arguments that an id accepts in addition to its registered name and variant."""
    creator = load_env_creator(str(gym.spec(id).entry_point))
    return {name: each for name, each in signature(creator).parameters.items()
            if name not in ("name", "variant")}


def ids(track: str | None = None) -> list[str]:
    """Return the registered ids of one track, or of all, in the order of registration."""
    return [id for id, each in entries().items() if track in (None, each.track)]


def measured_ids() -> list[str]:
    """Return the ids of measured cases, which no default suite contains."""
    return [id for id in gym.registry if is_measured(id)]


def is_measured(id: str) -> bool:
    """Return whether an id is a measured case, without simulated truth."""
    return id in gym.registry and gym.registry[id].entry_point == MEASURED


def builtin_ids() -> list[str]:
    """Return the built-in ids."""
    return [id for id in ids() if id.startswith("eitbench/")]


def track_of(id: str) -> str:
    """Return the track of an id; ``ValueError`` if the id is unknown."""
    return "estimation" if is_measured(id) else entry(id).track


def nominal_id(id: str) -> str:
    """Return the nominal id of a shifted environment, which has the same task; else empty."""
    return "" if is_measured(id) else entry(id).nominal


def check_track(id: str, track: str) -> None:
    """Raise ``ValueError`` if an environment is unknown or of another track."""
    if track_of(id) != track:
        raise ValueError(f"environment {id} is not of the track {track}; see `eitbench list`")


def registered_kwargs(id: str) -> dict[str, Any]:
    """Return the arguments that an id was registered with; empty for an unknown id."""
    each = entries().get(id)
    if each is None:
        return dict(gym.registry[id].kwargs) if is_measured(id) else {}
    return RUN_KWARGS[each.track] | dict(each.settings)


def environment_name(id: str, given: dict[str, Any]) -> str:
    """Return the name of an id with arguments that differ from the registered ones."""
    text = json.dumps(given, sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    return id.replace("/", "-") + (f"-{digest}" if given else "")


def qualified_name(environment: Mapping[str, Any]) -> str:
    """Return the id of a record's environment, with the suffix of its name where arguments differ
    from the registered ones."""
    return str(environment["id"] + environment["name"][len(environment["id"]):])


def record_name(environment: str, method: str, version: str, split: str) -> str:
    """Return a record's file name: ``ENV--METHOD--VERSION.json``, with the split unless test."""
    parts = [environment, method, version, *[split] * (split != "test")]
    return "--".join(parts) + ".json"


def subtrack_of(env: EstimationEnv | InjectionEnv) -> str:
    """Return the subtrack of an environment, one of its track's `SUBTRACKS`."""
    lag = getattr(env, "lag", None)
    # an environment of measurements has no world
    return "injection" if lag is None else _subtrack_of_lag(lag, getattr(env, "world", None))


def subtrack_of_id(id: str, kwargs: Mapping[str, Any] = MappingProxyType({})) -> str:
    """Return the subtrack of a registered id with these arguments, without making it;
    ``ValueError`` if an argument is invalid."""
    for name in kwargs:
        _check.choice(f"argument of {id}", name, _parameters(id))
    if track_of(id) == "injection":
        return "injection"
    from eitbench.envs.estimation import resolve_arguments
    changes = {name: kwargs.get(name) for name in ("world", "lag", "assume")}
    world, lag, _ = resolve_arguments(id, **changes)
    return _subtrack_of_lag(lag, world)


def _subtrack_of_lag(lag: int, world: Any) -> str:
    if lag == 0:
        return "filter"
    return "smoothing" if lag == world.n_steps - 1 else "fixed-lag"


def default_seeds(id: str, suite: str = "full") -> list[int]:
    """Return the default seeds of an environment, which are test episodes."""
    if is_measured(id):
        return parse_seeds(MEASURED_SEEDS)
    return parse_seeds(QUICK_SEEDS if suite == "quick" else entry(id).test_seeds)
