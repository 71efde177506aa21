"""Methods, estimators and injection policies alike: find and load them, one Python file each."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import re
import sys
import warnings
from collections.abc import Callable, Mapping
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from eitbench import _check
from eitbench._files import readable, shipped
from eitbench._foreign import where_of
from eitbench._notice import say
from eitbench.bench.tracks import BOARDS, TRACKS

METHODS = "eitbench.methods"
"""Entry points of installed packages: a method's name, and its module of that name."""
LOADERS = "eitbench.loaders"
"""Entry points that load a policy from another kind of file: named by its suffix, called with path
and content."""
ROLES = (None, "floor", "reference")
"""What a method is on a board: ranked, or a mark from which the others are judged."""

MOST_BYTES = 1 << 28
"""of a method's file, which is read whole"""
TITLE = 120
"""letters of a title"""
PARAMETERS = 10_000
"""bytes of JSON that the parameters of a method may take in a record"""
ELSEWHERE = ("models of our trained agents are in a checkout only, not in an installed package; "
             "--policy takes the path of a model.zip")


class Form(NamedTuple):
    """How the methods of a track are written."""

    kind: str
    """As commands and messages call them."""
    type: str
    """Name of the class that a file defines."""
    answers: str
    """Its method, and what that takes."""
    files: str
    """What a path may lead to."""
    folder: str
    """Where ours lie, below `baseline_folder`."""


FORMS = {
    "estimation": Form("baseline", "Estimator", "update(voltages, currents)", "a .py file", "."),
    "injection": Form("policy", "Policy", "act(observation)",
                      "a .py file or of an agent's model.zip", "injection"),
}
"""Of each track."""


class Method(NamedTuple):
    """A loaded method."""

    track: str
    """One of `TRACKS`: whether it is an estimator or a policy."""
    name: str
    """Name of the file without its suffix; of an agent, algorithm and seed."""
    title: str
    """First line of its docstring, up to a colon, bracket or full stop."""
    path: Path
    sha256: str
    boards: tuple[str, ...]
    """Those of its track that it can play."""
    parameters: dict[str, Any]
    make: Callable[..., Any]
    """Estimator(task), with update(voltages, currents) -> Estimate or None; or
    Policy(rules, random), with act(observation) -> action."""
    role: str | None = None
    """One of `ROLES`."""
    privileged: bool = False
    """Shown the truth: Estimator(task, revealed), with the episode's flow and whole record;
    Policy(rules, random, core). A mark for the others, not one of them."""

    @property
    def version(self) -> str:
        """As `version_of`."""
        return version_of(self.path, self.sha256)

    def suits(self, world: Any) -> bool:
        """Whether it can play a `Task` of its boards, or under these `Rules`; a method without a
        word on that suits all."""
        judge = getattr(self.make, "suits", None)
        return judge is None or bool(judge(world))


def baseline_folder() -> Path:
    """Where our own methods lie."""
    return shipped("baselines")


def own_methods(track: str) -> list[str]:
    """Names of our own methods of a track, without agents."""
    return sorted(path.stem for path in (baseline_folder() / FORMS[track].folder).glob("*.py"))


def own_agents(id: str) -> list[str]:
    """Paths of our own trained agents for an environment; none without the extra ``rl``, and none
    where their models are not, which is said."""
    if not importlib.util.find_spec("stable_baselines3"):
        return []
    there = [str(path) for path in _agents(id) if path.is_file()]
    if not there and _agents(id):
        say(f"our agents for {id} are left out: {ELSEWHERE}")
    return there


def own_files(id: str) -> dict[str, Path]:
    """Name under which results are kept in an environment -> file, of each of our own methods and
    of its agents, whose models may be elsewhere."""
    folders = [baseline_folder() / form.folder for form in FORMS.values()]
    return ({path.stem: path for folder in folders for path in sorted(folder.glob("*.py"))}
            | {f"{path.parents[1].name}_{path.parent.name}": path for path in _agents(id)})


def _agents(id: str) -> list[Path]:
    """``baselines/checkpoints/ENV/ALGO/seedK/model.zip``"""
    folder = baseline_folder() / "checkpoints" / id.replace("/", "-")
    return [path.with_name("model.zip") for path in sorted(folder.glob("*/seed*/sha256"))]


def own_sha256(path: Path) -> str:
    """Of the file of one of our own methods; of an agent what its training left beside it."""
    if path.suffix == ".py":
        return hashlib.sha256(path.read_bytes()).hexdigest()
    return path.with_name("sha256").read_text(encoding="ascii").strip()


def is_ours(name: str) -> bool:
    """Whether a method, by name or by path, is one of ours: it lies in our folder."""
    if is_path(name):
        return Path(name).resolve().is_relative_to(baseline_folder().resolve())
    return any(name in own_methods(track) for track in TRACKS)


def is_path(name: str) -> bool:
    """Whether a method is named by the path of its file, by its suffix."""
    return Path(name).suffix in {".py", *_loaders()}


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
        if is_ours(point.name) or path is None or path.stem != point.name:
            warnings.warn(f"method {point.name} of {point.value} is left out: it must be a module "
                          "of that name, and none of ours may have it", stacklevel=2)
        else:
            found[point.name] = path
    return found


@lru_cache(maxsize=1)
def _loaders() -> dict[str, EntryPoint]:
    """Suffix -> what loads such files."""
    return {f".{point.name}": point for point in entry_points(group=LOADERS)}


def loader_of(path: Path) -> str:
    """Return the module and function that load a method's file; empty for a .py file."""
    point = _loaders().get(path.suffix)
    return "" if point is None else point.value


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
    path = baseline_folder() / "golden" / f"{name}.json"
    if not path.is_file():
        return 1
    return int(json.loads(path.read_text(encoding="utf-8"))["version"])


def find_method(name: str, track: str) -> Path:
    """The file of one of our methods by name, of an installed package's, or anybody's by its path.

    Raises
    ------
    ValueError
        If there is none, or it has the name of another.
    """
    form = FORMS[track]
    folder = baseline_folder() / form.folder
    own = own_methods(track)
    if is_path(name):
        path = readable(Path(name))
    else:
        known = installed_methods() | {each: folder / f"{each}.py" for each in own}
        path = known.get(name, Path())
    if not path.is_file():
        names = [*own, *installed_methods()]
        hint = (f": {ELSEWHERE}" if "checkpoints" in path.parts
                else _check.nearest(name, names))
        raise ValueError(f"{form.kind} must be the path of {form.files}, or one of "
                         f"{', '.join(names)}; got {name!r}{hint}")
    if path.stat().st_size > MOST_BYTES:
        raise ValueError(f"{form.kind} {path} must have {MOST_BYTES >> 20} MiB at most")
    if path.stem in own and not path.samefile(folder / f"{path.stem}.py"):
        raise ValueError(f"{form.kind} {path} has the name of one of ours, under which results are "
                         "kept; rename it")
    return path


def load_method(name: str, track: str) -> Method:
    """Load one of our methods by name, of an installed package's, or anybody's by the path of its
    file; a trained agent by that of its model.zip.

    Raises
    ------
    ValueError
        If there is no such method, its file has no class as its track asks for, or an agent's file
        is not the one that training left.
    """
    path = find_method(name, track)
    return _load(path, path.read_bytes(), track)


@lru_cache(maxsize=64)
def _load(path: Path, source: bytes, track: str) -> Method:
    """The file with this content, executed once a process."""
    sha256 = hashlib.sha256(source).hexdigest()
    form = FORMS[track]
    if track == "injection" and path.suffix in _loaders():
        name, title, agent, parameters = _loaders()[path.suffix].load()(path, source)
        _check.document(f"{form.kind} {path}: parameters", parameters, PARAMETERS)
        return Method(track, name, title, path, sha256, BOARDS[track], parameters, agent)
    module = load_module(form.kind, path, source)
    method = getattr(module, form.type, None)
    if not isinstance(method, type) or not _answers(method, form):
        raise ValueError(f"{form.kind} {path} must define a class {form.type} with a method "
                         f"{form.answers}")
    return method_of(method, track, path.stem, str(path))._replace(
        title=title_of(module, path), path=path, sha256=sha256)


def method_of(method: type[Any], track: str, name: str, where: str = "") -> Method:
    """A class as a method of a track, without a file. ``ValueError``, saying ``where`` it is
    (default: its name), if it is not as that asks for."""
    form = FORMS[track]
    who = f"{form.kind} {where or name}: {method.__name__}"
    if not _answers(method, form):
        raise ValueError(f"{who} must have a method {form.answers}")
    boards = tuple(getattr(method, "boards", BOARDS[track][:1]))
    if not boards or not set(boards) <= set(BOARDS[track]):
        raise ValueError(f"{who}.boards must be some of {', '.join(BOARDS[track])}, got {boards!r}")
    role = getattr(method, "role", None)
    if role not in ROLES:
        raise ValueError(f"{who}.role must be None, 'floor' or 'reference', got {role!r}")
    privileged = getattr(method, "privileged", False)
    if not isinstance(privileged, bool):
        raise ValueError(f"{who}.privileged must be True or False, got {privileged!r}")
    return Method(track, name, name, Path(), "", boards, _parameters(who, method), method, role,
                  privileged)


def _answers(method: type[Any], form: Form) -> bool:
    return callable(getattr(method, form.answers.partition("(")[0], None))


def load_module(kind: str, path: Path, source: bytes) -> ModuleType:
    """The module that a file's content makes; ``ValueError``, naming ``kind`` and path, if it
    cannot be executed."""
    name = f"eitbench_{kind}_{path.stem}"
    specification = importlib.util.spec_from_file_location(name, path)
    assert specification is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module  # dataclasses look their module up
    try:
        # a cached .pyc may lag behind an edit by a second
        exec(compile(source, path, "exec"), module.__dict__)
    except Exception as error:
        where = "" if isinstance(error, SyntaxError) else f" ({where_of(error, path)})"
        raise ValueError(f"{kind} {path} cannot be loaded: {type(error).__name__}: {error}{where}"
                         ) from error
    return module


def title_of(module: ModuleType, path: Path) -> str:
    """First line of the docstring, up to a colon, bracket or full stop, 120 letters at most;
    without one, the file's name."""
    line = f"{(module.__doc__ or '').strip()}\n".splitlines()[0]
    return re.split(r"[:(.]", line)[0].strip()[:TITLE].strip() or path.stem


def _parameters(who: str, method: type[Any]) -> dict[str, Any]:
    """The class attribute ``parameters``; ``ValueError``, naming ``who``, if a record cannot hold
    them."""
    given = getattr(method, "parameters", {})
    parameters = dict(given) if isinstance(given, Mapping) else given
    _check.document(f"{who}.parameters", parameters, PARAMETERS)
    return parameters
