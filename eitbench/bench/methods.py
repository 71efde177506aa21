"""Find and load methods (estimators and injection policies), one Python file each."""

from __future__ import annotations

import ast
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
from eitbench._files import bundled_path, resolve_input
from eitbench._notice import notify
from eitbench._sanitize import error_location
from eitbench.bench.tracks import SUBTRACKS, TRACKS

METHOD_GROUP = "eitbench.methods"
"""Entry-point group of installed packages: a method's name, and its module of that name."""
LOADER_GROUP = "eitbench.loaders"
"""Entry-point group of functions that load a policy from another kind of file: each has the name of
the file's suffix and is called with path and content."""
ROLES = (None, "floor", "reference")
"""Role of a method on a leaderboard: ranked, naive baseline, or oracle."""
AGENT_FILES = ("config.json", "sha256")
"""Files in the folder of an agent's model.zip."""
MAX_METHOD_BYTES = 1 << 28
MAX_TITLE_CHARS = 120
MAX_PARAMETERS_BYTES = 10_000
"""size of a method's parameters as JSON in a record"""
AGENTS_NOT_BUNDLED = ("checkpoints of built-in agents are in a checkout only, not in an installed "
                      "package; --policy takes the path of a model.zip")


class MethodKind(NamedTuple):
    """Kind of the methods of a track: its word in messages, the class that a file defines, the
    method of the class, the accepted files, and the built-in folder below `baseline_folder`."""

    kind: str
    type: str
    interface: str
    files: str
    folder: str


METHOD_KINDS = {
    "estimation": MethodKind("baseline", "Estimator", "update(voltages, currents)", "a .py file",
                             "."),
    "injection": MethodKind("policy", "Policy", "act(observation)",
                            "a .py file or of an agent's model.zip", "injection"),
}


class Method(NamedTuple):
    """A loaded method."""

    track: str
    """One of `TRACKS`: estimators or policies."""
    name: str
    """Name of the file without its suffix; for an agent, algorithm and training seed."""
    title: str
    """See `title_of`."""
    path: Path
    sha256: str
    subtracks: tuple[str, ...]
    """Subtracks of its track that it can run on."""
    parameters: dict[str, Any]
    make: Callable[..., Any]
    """Estimator(task), with update(voltages, currents) -> Estimate or None; or
    Policy(rules, random), with act(observation) -> action."""
    role: str | None = None
    """One of `ROLES`."""
    privileged: bool = False
    """True if it receives the ground truth: Estimator(task, revealed), with the flow and all
    measurements of the episode; Policy(rules, random, core)."""

    @property
    def version(self) -> str:
        """Version as defined by `version_of`."""
        return version_of(self.path, self.sha256)

    def suits(self, world: Any) -> bool:
        """Return whether it is compatible with a `Task` of its subtracks, or with `Rules`, as its
        optional function ``suits`` determines."""
        suits = getattr(self.make, "suits", None)
        return suits is None or bool(suits(world))


def baseline_folder() -> Path:
    """Return the folder of the built-in methods."""
    return bundled_path("baselines")


def builtin_methods(track: str) -> dict[str, Path]:
    """Map names to files of the built-in methods of a track, without agents."""
    folder = baseline_folder() / METHOD_KINDS[track].folder
    return {path.stem: path for path in sorted(folder.glob("*.py"))}


def builtin_agents(id: str) -> list[str]:
    """Return the paths of the built-in agents of an environment: an empty list without the extra
    ``rl`` or, with a notice, without their checkpoints."""
    if not importlib.util.find_spec("stable_baselines3"):
        return []
    agents = _agents(id)
    found = [str(path) for path in agents if path.is_file()]
    if agents and not found:
        notify(f"built-in agents for {id} are skipped: {AGENTS_NOT_BUNDLED}")
    return found


def builtin_files(id: str) -> dict[str, Path]:
    """Map the names of results to the files of all built-in methods and of the agents of an
    environment; checkpoints of agents may be missing."""
    return (builtin_methods("estimation") | builtin_methods("injection")
            | {f"{path.parents[1].name}_{path.parent.name}": path for path in _agents(id)})


def _agents(id: str) -> list[Path]:
    """Return the paths ``baselines/checkpoints/ENV/ALGO/seedK/model.zip``."""
    folder = baseline_folder() / "checkpoints" / id.replace("/", "-")
    return [path.with_name("model.zip") for path in sorted(folder.glob("*/seed*/sha256"))]


def builtin_sha256(path: Path) -> str:
    """Return the sha256 of a built-in method's file; for an agent it is in the file ``sha256``."""
    if path.suffix == ".py":
        return hashlib.sha256(path.read_bytes()).hexdigest()
    return path.with_name("sha256").read_text(encoding="ascii").strip()


def is_builtin(name: str) -> bool:
    """Return whether a method, given by name or path, is in the folder of built-in methods."""
    if is_path(name):
        return Path(name).resolve().is_relative_to(baseline_folder().resolve())
    return any(name in builtin_methods(track) for track in TRACKS)


def is_path(name: str) -> bool:
    """Return whether a method is given by the path of its file, which the suffix shows."""
    return Path(name).suffix in {".py", *_loaders()}


@lru_cache(maxsize=1)
def installed_methods() -> dict[str, Path]:
    """Map names to files of the methods of installed packages (entry points `METHOD_GROUP`). A
    method with a built-in name, or without a file, is skipped with a warning."""
    found = {}
    for point in entry_points(group=METHOD_GROUP):
        try:
            specification = importlib.util.find_spec(point.value)
        except ImportError:
            specification = None
        path = Path(specification.origin) if specification and specification.origin else None
        if is_builtin(point.name) or path is None or path.stem != point.name:
            warnings.warn(f"method {point.name} of {point.value} is skipped: it must be a module "
                          "of that name, and differ from built-in names", stacklevel=2)
        else:
            found[point.name] = path
    return found


@lru_cache(maxsize=1)
def _loaders() -> dict[str, EntryPoint]:
    """Map file suffixes to the entry points of loaders."""
    return {f".{point.name}": point for point in entry_points(group=LOADER_GROUP)}


def loader_of(path: Path) -> str:
    """Return the module and function that load a method's file; empty for a .py file."""
    point = _loaders().get(path.suffix)
    return "" if point is None else point.value


def version_of(path: Path, sha256: str) -> str:
    """Return the version of a method in records: for a built-in method the version of its golden
    file, for others eight digits of the sha256 of its file."""
    return f"v{golden_version(golden_name(path))}" if is_builtin(str(path)) else sha256[:8]


def golden_name(path: Path) -> str:
    """Return the name of a built-in method's golden file: the name of its file; agents of one
    environment and algorithm share a golden file."""
    folders = path.resolve().parents
    return path.stem if path.suffix == ".py" else f"{folders[2].name}--{folders[1].name}"


@lru_cache(maxsize=256)
def golden_version(name: str) -> int:
    """Return the version of a golden file; 1 if it is missing."""
    path = baseline_folder() / "golden" / f"{name}.json"
    if not path.is_file():
        return 1
    return int(json.loads(path.read_text(encoding="utf-8"))["version"])


def method_files(path: Path) -> dict[str, bytes]:
    """Map names to contents of the files of a method: its own first, then the files that its class
    names in ``files = ("weights.npz",)``, or that `eitbench.rl.save_agent` writes with a model.

    The source is parsed, not executed. ``ValueError`` if a named file is not in the folder."""
    contents = {path.name: _content(path)}
    if path.suffix != ".py":
        return contents | {name: path.with_name(name).read_bytes()
                           for name in AGENT_FILES if path.with_name(name).is_file()}
    try:
        names = _class_attribute(contents[path.name], "files", ())
    except SyntaxError:             # loading reports the error
        names = ()
    except ValueError:              # not a literal
        names = None
    if not isinstance(names, tuple) or not all(isinstance(each, str) for each in names):
        raise ValueError(f"{path}: files must be a literal tuple of names of files")
    for name in names:
        file = path.with_name(name) if name == Path(name).name else Path()
        if not file.is_file():
            raise ValueError(f"{path}: files must name files in the folder of the method, got "
                             f"{name!r}, which does not exist there")
        contents[name] = _content(file)
    return contents


def _content(path: Path) -> bytes:
    if path.stat().st_size > MAX_METHOD_BYTES:
        raise ValueError(f"{path} must have {MAX_METHOD_BYTES >> 20} MiB at most")
    return path.read_bytes()


@lru_cache(maxsize=256)
def _class_attribute(source: bytes, name: str, default: Any) -> Any:
    """Return the literal value of an attribute of the class `Estimator` or `Policy`."""
    types = {kind.type for kind in METHOD_KINDS.values()}
    body = (each for node in ast.parse(source).body if isinstance(node, ast.ClassDef)
            and node.name in types for each in node.body if isinstance(each, ast.Assign))
    return next((ast.literal_eval(each.value) for each in body
                 if ast.unparse(each.targets[0]) == name), default)


def builtin_summary(name: str, track: str) -> tuple[str, tuple[str, ...]]:
    """Return title and subtracks of a built-in method from its source, without executing it."""
    source = find_method(name, track).read_bytes()
    return (title_of(ast.get_docstring(ast.parse(source)), name),
            _class_attribute(source, "subtracks", SUBTRACKS[track][:1]))


def title_of(docstring: str | None, name: str) -> str:
    """Return the title in a method's docstring: its first line up to a colon or full stop, at most
    `MAX_TITLE_CHARS` characters; the method's name without one."""
    paragraph = " ".join((docstring or "").strip().split("\n\n")[0].split())
    return re.split(r"[.:](?:\s|$)", paragraph)[0][:MAX_TITLE_CHARS].strip() or name


def method_sha256(contents: Mapping[str, bytes]) -> str:
    """Return the sha256 of a method from its `method_files`: the digest of its file, or of the list
    of all names and digests if the class names files."""
    (name, source), *others = contents.items()
    if not others or not name.endswith(".py"):
        return hashlib.sha256(source).hexdigest()
    lines = [f"{each} {hashlib.sha256(content).hexdigest()}\n"
             for each, content in contents.items()]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def find_method(name: str, track: str) -> Path:
    """Return the file of a method by its name, if it is built in or installed, or by its path.
    ``ValueError`` if the file is missing, or has the name of another method."""
    form = METHOD_KINDS[track]
    own = builtin_methods(track)
    if is_path(name):
        path = resolve_input(Path(name))
    else:
        known = installed_methods() | own
        _check.choice(f"{form.kind}, if not the path of {form.files},", name, known)
        path = known[name]
    if not path.is_file():
        hint = f": {AGENTS_NOT_BUNDLED}" if "checkpoints" in path.parts else ""
        raise ValueError(f"{form.kind} {path} does not exist, or is not a file{hint}")
    if path.stem in own and not path.samefile(own[path.stem]):
        raise ValueError(f"{form.kind} {path} has the name of a built-in method, under which "
                         "results are stored; rename it")
    return path


def load_method(name: str, track: str) -> Method:
    """Load the method that `find_method` returns; a trained agent by the path of its model.zip.
    ``ValueError`` if it is missing, its file lacks the class that its track requires, or an agent's
    file was changed after its training."""
    path = find_method(name, track)
    contents = method_files(path)
    return _load(path, contents[path.name], method_sha256(contents), track)


@lru_cache(maxsize=64)
def _load(path: Path, source: bytes, sha256: str, track: str) -> Method:
    """Load the file with this content, which is executed once per process."""
    form = METHOD_KINDS[track]
    if track == "injection" and path.suffix in _loaders():
        name, title, agent, parameters = _loaders()[path.suffix].load()(path, source)
        _check.json_object(f"{form.kind} {path}: parameters", parameters, MAX_PARAMETERS_BYTES)
        return Method(track, name, title, path, sha256, SUBTRACKS[track], parameters, agent)
    module = load_module(form.kind, path, source)
    method = getattr(module, form.type, None)
    if not isinstance(method, type):
        raise ValueError(f"{form.kind} {path} must define a class {form.type} with a method "
                         f"{form.interface}")
    return method_from_class(method, track, path.stem, str(path))._replace(
        title=title_of(module.__doc__, path.stem), path=path, sha256=sha256)


def method_from_class(method: type[Any], track: str, name: str, where: str = "") -> Method:
    """Return a class as a method of a track, without a file. ``ValueError``, naming ``where`` it is
    defined (default: its name), if it does not meet the requirements of the track."""
    form = METHOD_KINDS[track]
    who = f"{form.kind} {where or name}: {method.__name__}"
    if not callable(getattr(method, form.interface.partition("(")[0], None)):
        raise ValueError(f"{who} must have a method {form.interface}")
    given = {key: getattr(method, key) for key in ("role", "privileged", "parameters", "subtracks")
             if hasattr(method, key)}
    if hasattr(method, "boards"):           # name of `subtracks` in older files
        given.setdefault("subtracks", method.boards)
    return method_from_attributes(track, name, who, method, given)


def method_from_attributes(track: str, name: str, who: str, make: Callable[..., Any],
                   given: Mapping[str, Any]) -> Method:
    """Return a method with the ``given`` attributes of its class, without a file. ``ValueError``,
    naming ``who`` has them, if they are invalid."""
    subtracks = given.get("subtracks", SUBTRACKS[track][:1])
    if (not subtracks or not isinstance(subtracks, list | tuple)
            or any(each not in SUBTRACKS[track] for each in subtracks)):
        raise ValueError(f"{who}.subtracks must be some of {', '.join(SUBTRACKS[track])}, got "
                         f"{subtracks!r}")
    role, privileged = given.get("role"), given.get("privileged", False)
    if role not in ROLES:
        raise ValueError(f"{who}.role must be among {', '.join(map(repr, ROLES))}; got {role!r}")
    if not isinstance(privileged, bool):
        raise ValueError(f"{who}.privileged must be True or False, got {privileged!r}")
    parameters = given.get("parameters", {})
    if isinstance(parameters, Mapping):
        parameters = dict(parameters)
    _check.json_object(f"{who}.parameters", parameters, MAX_PARAMETERS_BYTES)
    return Method(track, name, name, Path(), "", tuple(subtracks), parameters, make, role,
                  privileged)


def load_module(kind: str, path: Path, source: bytes) -> ModuleType:
    """Execute a file's content as a module; ``ValueError``, naming kind and path, if it fails."""
    name = f"eitbench_{kind}_{path.stem}"
    specification = importlib.util.spec_from_file_location(name, path)
    assert specification is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module  # dataclasses look their module up
    try:
        # not a cached .pyc, which may be outdated within a second after an edit
        exec(compile(source, path, "exec"), module.__dict__)
    except Exception as error:
        where = "" if isinstance(error, SyntaxError) else f" ({error_location(error, path)})"
        raise ValueError(f"{kind} {path} cannot be loaded: {type(error).__name__}: {error}{where}"
                         ) from error
    return module
