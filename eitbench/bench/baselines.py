"""Find and load baselines: one Python file each, with a class `Estimator`."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import re
import sys
import warnings
from collections.abc import Callable
from functools import lru_cache
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

from eitbench._files import shipped

if TYPE_CHECKING:
    from eitbench.worlds.task import Task

METHODS = "eitbench.methods"
"""Entry points of installed packages: a method's name, and its module of that name."""
BOARDS = ("filter", "fixed-lag", "smoothing")
ROLES = (None, "floor", "reference")
"""What a method is on a board: ranked, or a mark from which the others are judged."""


class Baseline(NamedTuple):
    """A loaded baseline file."""

    name: str
    """Name of the file without its suffix."""
    title: str
    """First line of its docstring, up to a colon, bracket or full stop."""
    path: Path
    sha256: str
    boards: tuple[str, ...]
    """The boards it can play: `BOARDS`."""
    parameters: dict[str, Any]
    estimator: Callable[..., Any]
    """Estimator(task), with update(voltages, currents) -> Estimate or None."""
    role: str | None = None
    """One of `ROLES`."""
    privileged: bool = False
    """Shown the episode's flow and whole record: Estimator(task, revealed). A mark for the others,
    not one of them."""

    @property
    def version(self) -> str:
        """As `version_of`."""
        return version_of(self.path, self.sha256)

    def suits(self, task: Task) -> bool:
        """Whether it can play a task of its boards; an estimator without a word on that suits all."""
        judge = getattr(self.estimator, "suits", None)
        return judge is None or bool(judge(task))


def baseline_folder() -> Path:
    """Where our own baselines lie."""
    return shipped("baselines")


def own_baselines() -> list[str]:
    """Names of our own baselines."""
    return sorted(path.stem for path in baseline_folder().glob("*.py"))


def own_names(id: str) -> set[str]:
    """Under which results of our own methods are kept in an environment: of files, and of its
    trained agents."""
    folder = baseline_folder()
    agents = (folder / "checkpoints" / id.replace("/", "-")).glob("*/seed*/model.zip")
    return {path.stem for pattern in ("*.py", "injection/*.py") for path in folder.glob(pattern)} | {
        f"{path.parents[1].name}_{path.parent.name}" for path in agents}


def is_ours(name: str) -> bool:
    """Whether a method, by name or by path, is one of ours: it lies in our folder."""
    if not name.endswith((".py", ".zip")):
        return name not in installed_methods()
    return Path(name).resolve().is_relative_to(baseline_folder().resolve())


@lru_cache(maxsize=1)
def installed_methods() -> dict[str, Path]:
    """Name -> file of each method that an installed package offers (entry points `METHODS`).

    A package that takes a name of ours, or whose file is not to be found, is left out with a
    warning.
    """
    found = {}
    for point in entry_points(group=METHODS):
        try:
            specification = importlib.util.find_spec(point.value)
        except ImportError:
            specification = None
        path = Path(specification.origin) if specification and specification.origin else None
        if point.name in own_baselines() or path is None or path.stem != point.name:
            warnings.warn(f"method {point.name} of {point.value} is left out: it must be a module of "
                          "that name, and none of ours may have it", stacklevel=2)
        else:
            found[point.name] = path
    return found


def version_of(path: Path, sha256: str) -> str:
    """What a method's records say of its version: of ours that of its card, v1 where there is none;
    of all others eight digits of their file's sha256."""
    return f"v{card_version(card_name(path))}" if is_ours(str(path)) else sha256[:8]


def card_name(path: Path) -> str:
    """Of the card of one of our methods: that of its file; agents of one environment and algorithm
    share one."""
    folders = path.resolve().parents
    return path.stem if path.suffix == ".py" else f"{folders[2].name}--{folders[1].name}"


@lru_cache(maxsize=256)
def card_version(name: str) -> int:
    """The number of the version that a card describes; 1 where there is no card."""
    path = baseline_folder() / "cards" / f"{name}.json"
    return int(json.loads(path.read_text(encoding="utf-8"))["version"]) if path.is_file() else 1


def find_baseline(name: str) -> Path:
    """The file of one of our baselines by name, or anybody's by its path; ``ValueError`` if there
    is none, or it has the name of another."""
    path = file_of(name, baseline_folder())
    if not path.is_file():
        known = [*own_baselines(), *installed_methods()]
        raise ValueError(f"baseline must be a path to a .py file or one of {', '.join(known)}; got {name!r}")
    if path.stem in own_baselines() and not path.samefile(baseline_folder() / path.name):
        raise ValueError(f"baseline {path} has the name of one of ours, under which results are kept; rename it")
    return path


def file_of(name: str, folder: Path) -> Path:
    """Where a method lies that is named by path, or of an installed package, or of ours."""
    return Path(name) if name.endswith((".py", ".zip")) else installed_methods().get(
        name, folder / f"{name}.py")


def load_baseline(name: str) -> Baseline:
    """Load one of our baselines by name, or anybody's by the path of its file.

    Raises
    ------
    ValueError
        If there is no such baseline, or its file has no class `Estimator` with an `update` method.
    """
    path = find_baseline(name)
    return _load(path, path.read_bytes())


@lru_cache(maxsize=64)
def _load(path: Path, source: bytes) -> Baseline:
    """The file with this content, executed once a process."""
    module = load_module("baseline", path, source)
    estimator = getattr(module, "Estimator", None)
    if estimator is None or not callable(getattr(estimator, "update", None)):
        raise ValueError(f"baseline {path} must define a class Estimator with a method update(voltages, currents)")
    boards = tuple(getattr(estimator, "boards", ("filter",)))
    if not boards or not set(boards) <= set(BOARDS):
        raise ValueError(f"baseline {path}: Estimator.boards must be some of {', '.join(BOARDS)}, got {boards!r}")
    who = f"baseline {path}: Estimator"
    return Baseline(path.stem, title_of(module, path), path, hashlib.sha256(source).hexdigest(), boards,
                    parameters_of(who, estimator), estimator, role_of(who, estimator),
                    is_privileged(who, estimator))


def load_module(kind: str, path: Path, source: bytes) -> ModuleType:
    """The module that a file's content makes; ``ValueError``, naming ``kind`` and path, if it
    cannot be executed."""
    specification = importlib.util.spec_from_file_location(f"eitbench_{kind}_{path.stem}", path)
    assert specification is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules[specification.name] = module  # dataclasses look their module up
    try:
        # a cached .pyc may lag behind an edit by a second
        exec(compile(source, path, "exec"), module.__dict__)
    except Exception as error:
        raise ValueError(f"{kind} {path} cannot be loaded: {type(error).__name__}: {error}") from error
    return module


def title_of(module: ModuleType, path: Path) -> str:
    """First line of the docstring, up to a colon, bracket or full stop, 120 letters at most;
    without one, the file's name."""
    line = f"{(module.__doc__ or '').strip()}\n".splitlines()[0]
    return re.split(r"[:(.]", line)[0].strip()[:120] or path.stem


def parameters_of(who: str, method: type[Any]) -> dict[str, Any]:
    """The class attribute ``parameters``; ``ValueError``, naming ``who``, if JSON cannot hold them."""
    try:
        json.dumps(parameters := dict(getattr(method, "parameters", {})), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{who}.parameters must be a dict fit for JSON: {error}") from None
    return parameters


def is_privileged(who: str, method: type[Any]) -> bool:
    """The class attribute ``privileged``; ``ValueError``, naming ``who``, if it is neither True nor
    False."""
    privileged = getattr(method, "privileged", False)
    if not isinstance(privileged, bool):
        raise ValueError(f"{who}.privileged must be True or False, got {privileged!r}")
    return privileged


def role_of(who: str, method: type[Any]) -> str | None:
    """The class attribute ``role``; ``ValueError``, naming ``who``, if it is none of `ROLES`."""
    role = getattr(method, "role", None)
    if role not in ROLES:
        raise ValueError(f"{who}.role must be None, 'floor' or 'reference', got {role!r}")
    return role
