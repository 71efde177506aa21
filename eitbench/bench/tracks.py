"""What is asked, and where: the registered environments, their track, their boards, and the seeds
that are played.

All that the benchmark knows of ids is in this file.
"""

from __future__ import annotations

import hashlib
import json
from inspect import Parameter, signature
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator

from eitbench.data.seeds import parse_seeds
from eitbench.worlds.registry import entries, entry

if TYPE_CHECKING:
    from eitbench.envs.estimation import EstimationEnv
    from eitbench.envs.injection import InjectionEnv

TRACKS = ("estimation", "injection")
"""What may be asked for: an estimate of every state, or the next current."""
BOARDS = {"estimation": ("filter", "fixed-lag", "smoothing"), "injection": ("injection",)}
"""Of each track: in estimation, by how late the estimate of a state is asked for."""
ALL_BOARDS = tuple(board for boards in BOARDS.values() for board in boards)
CLASSES = ("filter", "fixed-lag", "smoothing", "stationary", "injection")
"""What is ranked together: the boards, and targets that stand still apart."""
FLOORS = {"estimation": "homogeneous", "injection": "random_pair"}
"""Whose episodes are the board's, and from whose error the gain is counted."""
ARGUMENTS = {
    "estimation": ("world", "lag", "assume", "episodes", "render_mode"),
    "injection": ("world", "estimator", "observation", "gate", "inflow", "episodes",
                  "render_mode")}
"""What may be given to an environment of each track, beside its name."""
ESTIMATORS = ("full", "reduced")
"""What may stand inside an injection environment: the exact filter, for scores, or that of
training."""

MEASURED = "eitbench.envs.measured:case_env"
"""Entry point of the ids of measured cases."""
MEASURED_FILES = "eitbench-Measured-"
"""Beginning of the names of their records."""
MEASURED_SEEDS = "test:0-4"
"""Each withholds other readings of the same measurements."""
QUICK = ("eitbench/Pipe2D-v0", "eitbench/Pipe2DFixedLag-v0", "eitbench/Pipe2DSmoothing-v0")
"""What the quick suite runs; the full one runs all that ask for estimates."""
QUICK_SEEDS = "test:0-3"


SCORED = {"estimation": {}, "injection": {"estimator": "full", "observation": "raw"}}
"""Arguments of each track's environments in runs, unless others are given: with the exact filter,
and what policies are shown as it is. In training, registered ids have other defaults."""


class Environment(NamedTuple):
    """A registered id with keyword arguments: what is made, and what a record names."""

    id: str
    kwargs: str = "{}"
    """JSON"""

    @property
    def given(self) -> dict[str, Any]:
        """The arguments that differ from what is registered."""
        return changed(self.id, json.loads(self.kwargs))

    @property
    def name(self) -> str:
        """Fit for a folder; other arguments, other name."""
        return named(self.id, self.given)

    @property
    def track(self) -> str:
        """One of `TRACKS`; ``ValueError`` if there is no such environment."""
        return track_of(self.id)

    @property
    def arguments(self) -> dict[str, Any]:
        """All arguments with which it is made, defaults included."""
        creator = load_env_creator(str(gym.spec(self.id).entry_point))
        defaults = {name: each.default for name, each in signature(creator).parameters.items()
                    if each.default is not Parameter.empty}
        return defaults | registered(self.id) | SCORED[self.track] | json.loads(self.kwargs)

    def make(self, **extra: Any) -> EstimationEnv | InjectionEnv:
        """A fresh environment as it is played, without gymnasium's wrappers.

        Raises
        ------
        ValueError
            If there is none of this id, or its arguments are wrong.
        """
        arguments = SCORED[self.track] | json.loads(self.kwargs) | extra
        if arguments.get("estimator", "full") not in ESTIMATORS:
            raise ValueError(f"estimator must be one of {', '.join(ESTIMATORS)}, got "
                             f"{arguments['estimator']!r}")
        made: Any = gym.make(self.id, disable_env_checker=True, **arguments).unwrapped
        return made


def ids(track: str | None = None) -> list[str]:
    """Registered environments of one track, or of all, as they were registered."""
    return [id for id, each in entries().items() if track in (None, each.track)]


def measured_ids() -> list[str]:
    """Ids of measured cases, which no default suite contains."""
    return [id for id in gym.registry if is_measured(id)]


def is_measured(id: str) -> bool:
    """Whether an id is a measured case: its data have no simulated truth."""
    return id in gym.registry and gym.registry[id].entry_point == MEASURED


def own_ids() -> list[str]:
    """Those of ours."""
    return [id for id in ids() if id.startswith("eitbench/")]


def track_of(id: str) -> str:
    """One of `TRACKS`; ``ValueError`` if there is no environment of this id."""
    return "estimation" if is_measured(id) else entry(id).track


def home_of(id: str) -> str:
    """The id whose task estimators get in this one too, though the truth is another; else empty."""
    return "" if is_measured(id) else entry(id).home


def check_track(id: str, track: str) -> None:
    """``ValueError`` if an environment is of another track, or there is none."""
    if track_of(id) != track:
        asked = {"estimation": "estimates", "injection": "injections"}[track]
        raise ValueError(f"environment {id} does not ask for {asked}; env must be one of "
                         f"{', '.join(ids(track))}")


def registered(id: str) -> dict[str, Any]:
    """Arguments that an id was registered with; none for one that is not registered."""
    each = entries().get(id)
    if each is None:
        return dict(gym.registry[id].kwargs) if is_measured(id) else {}
    return SCORED[each.track] | dict(each.settings)


def changed(id: str, kwargs: dict[str, Any]) -> dict[str, Any]:
    """The arguments that make another world than the registered one, or other beliefs about it."""
    usual = {"world": {}} | registered(id)
    return {key: value for key, value in kwargs.items() if value is not None
            and (key not in usual or json.dumps(value) != json.dumps(usual[key]))}


def named(id: str, given: dict[str, Any]) -> str:
    """Name of an id with the arguments that differ from what is registered."""
    text = json.dumps(given, sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    return id.replace("/", "-") + (f"-{digest}" if given else "")


def record_name(environment: str, method: str, version: str, split: str) -> str:
    """Of a record's file: ``ENV--METHOD--VERSION.json``; of other seeds than test with their split
    in it too."""
    parts = [environment, method, version, *[split] * (split != "test")]
    return "--".join(parts) + ".json"


def board_of(env: EstimationEnv | InjectionEnv) -> str:
    """Which of its track's `BOARDS` an environment belongs to."""
    lag = getattr(env, "lag", None)
    if lag is None:
        return "injection"
    if lag == 0:
        return "filter"
    return "smoothing" if lag == env.world.n_steps - 1 else "fixed-lag"


def boards_of(id: str, kwargs: dict[str, Any]) -> tuple[str, ...]:
    """The boards that a registered id with these arguments may belong to, without making it: one,
    or two where only a world of somebody's own would say which.

    Raises
    ------
    ValueError
        If the arguments are not such as it takes.
    """
    track = track_of(id)
    for name, value in kwargs.items():
        if name not in ARGUMENTS[track]:
            raise ValueError(f"{name} is no argument of {id}; there are "
                             f"{', '.join(ARGUMENTS[track])}")
        if name in ("world", "assume") and not isinstance(value, dict | None):
            raise ValueError(f"{name} must be an object, got {type(value).__name__}")
    if track == "injection":
        return BOARDS[track]
    each = entry(id)
    lag = kwargs.get("lag")
    if lag is None:
        lag = each.settings.get("lag", 0)
    if lag == "all":
        return ("smoothing",)
    if type(lag) is not int or lag < 0:
        raise ValueError(f"lag must be 'all' or an integer of at least 0, got {lag!r}")
    if lag == 0:
        return ("filter",)
    if kwargs.get("world"):                                 # whose length is not computed here
        return ("fixed-lag", "smoothing")
    return ("smoothing",) if lag == each.world.n_steps - 1 else ("fixed-lag",)


def track_of_board(board: str) -> str:
    """One of `TRACKS`."""
    return next(track for track, boards in BOARDS.items() if board in boards)


def class_of(id: str, board: str) -> str:
    """Which of `CLASSES` a board of an environment belongs to; ``measured`` of a case."""
    if is_measured(id):
        return "measured"
    each = entries().get(id)
    at_rest = each is not None and getattr(each.world.target, "stands_still", False)
    return "stationary" if at_rest else board


def default_seeds(id: str, suite: str = "full") -> list[int]:
    """Return the default seeds of an environment: test episodes."""
    if is_measured(id):
        return parse_seeds(MEASURED_SEEDS)
    return parse_seeds(QUICK_SEEDS if suite == "quick" else entry(id).seeds)
