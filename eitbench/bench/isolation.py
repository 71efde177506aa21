"""Run a third-party estimator or policy in a separate process, optionally confined by bubblewrap.

The worker process receives measurements on its standard input and returns estimates or actions on
its standard output; messages are JSON and numeric arrays, and a worker's messages are never
unpickled. Under bubblewrap it has no network, no capabilities, a separate process table, and a file
system with only Python, installed packages, this package and a private /tmp (``docs/trust.md``).
"""

from __future__ import annotations

import atexit
import ctypes
import hashlib
import io
import json
import math
import os
import re
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache, partial
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import cloudpickle
import numpy as np

from eitbench import _check
from eitbench._files import PACKAGE
from eitbench._notice import notify
from eitbench._sanitize import error_location, sanitize, user_traceback
from eitbench.bench import methods
from eitbench.bench.methods import Method, is_builtin, is_path, load_method, method_sha256
from eitbench.bench.tracks import Environment, is_measured
from eitbench.data.cache import CACHE_VARIABLE, cache_folder, model_key
from eitbench.worlds.random_streams import generator_from_state
from eitbench.worlds.registry import import_entries, runtime_entries
from eitbench.worlds.task import Estimate

ISOLATE = ("auto", "none", "process", "bubblewrap")
"""Values of the option ``isolate``."""
CHECK_INTERVAL_S = 0.2
"""time between two checks of a worker's memory and number of threads"""
MAX_HEADER_BYTES = 1 << 20
MAX_ARRAY_BYTES = 1 << 28
MAX_OUTPUT_CHARS = 10_000
"""limit of the printed text that is shown for one reply"""
MAX_TEXT_CHARS = 2000
NUMERIC_ENV = ("OPENBLAS_", "MKL_", "OMP_", "NPY_", "NUMBA_CPU")
"""Prefixes of environment variables that change the last bits of results."""
ETC = ("alternatives", "group", "ld.so.cache", "localtime", "nsswitch.conf", "passwd")
_NUMERIC_DTYPE = re.compile(r"[<>|][biuf][1248]")
_ENTRY_POINTS = ("eitbench.worlds", "eitbench.methods", "eitbench.scores", "eitbench.loaders")


class WorkerError(RuntimeError):
    """A worker's method raised an exception, exceeded a limit, or sent a malformed message."""

    where = "worker"
    traceback = ""
    """Stack frames of the method's file that led to the error."""


class Limits(NamedTuple):
    """Resources that a worker and all processes it starts may use."""

    memory: int = 8 << 30
    """bytes of address space of one process, and of resident memory of all processes"""
    threads: int = 512
    """number of processes and threads"""
    disk: int = 1 << 30
    """bytes of one file, and of the private /tmp under bubblewrap"""


def choose_isolation(environment: Environment, method: str, isolate: str = "auto", *,
                     strict: bool = False) -> str:
    """Return ``none``, ``process`` or ``bubblewrap`` for a method, given by name or path.

    ``auto`` runs built-in methods in this process, and third-party files in a plain process, or
    under bubblewrap if ``strict``. Other values apply to built-in methods too, except privileged
    ones. On measurements every method runs in this process, because a worker could read withheld
    measurements from the file. ``ValueError`` if the value is invalid, bubblewrap is required and
    does not work, or with ``strict`` a third-party file would run in this process.
    """
    _check.choice("isolate", isolate, ISOLATE)
    third_party = not is_builtin(method)
    if is_measured(environment.id):
        if strict and third_party and isolate != "none":
            raise ValueError(f"{method} would run on measurements in this process, which only "
                             "--isolate none permits")
        return "none"
    kind = isolate
    if third_party and isolate == "auto":
        kind = "bubblewrap" if strict else "process"
    elif not third_party and (isolate == "auto"
                              or load_method(method, environment.track).privileged):
        kind = "none"
    if strict and third_party and kind == "none":
        raise ValueError(f"isolate must be bubblewrap or process for the third-party file {method}")
    if kind == "bubblewrap" and (reason := bubblewrap_problem()):
        raise ValueError(f"{method} must run under bubblewrap, but {reason}; install bubblewrap "
                         "(apt-get install bubblewrap), or accept a process that can read your "
                         "files with --isolate process")
    if kind == "process" and third_party:
        _notify_once(f"{method} runs in a separate process that can read your files; --isolate "
                     "bubblewrap confines it, --isolate none runs it in this process")
    return kind


_notify_once = cache(notify)


@cache
def bubblewrap_problem() -> str:
    """Return the reason why bubblewrap cannot confine a process here; empty if it can."""
    command = [*bubblewrap(Limits()), sys.executable, "-S", "-c", ""]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"bubblewrap does not start: {error}"
    return f"bubblewrap does not work here: {done.stderr.strip()}" if done.returncode else ""


def bubblewrap(limits: Limits, files: Mapping[str, str] | None = None) -> list[str]:
    """Return the command line that confines a program; ``files`` maps further paths inside the
    sandbox to readable files outside."""
    command = ["bwrap", "--unshare-all", "--die-with-parent", "--new-session", "--cap-drop", "ALL",
               "--proc", "/proc", "--dev", "/dev", "--size", str(1 << 26), "--tmpfs", "/dev/shm",
               "--size", str(limits.disk), "--tmpfs", "/tmp"]
    readable = {place: place for place in map(str, readable_paths())}
    for inside, outside in (readable | dict(files or {})).items():
        command += ["--ro-bind-try", outside, inside]
    return [*command, "--remount-ro", "/dev", "--remount-ro", "/", "--chdir", "/tmp"]


def readable_paths() -> list[Path]:
    """Return the files and folders that a worker under bubblewrap can read: Python, installed
    packages, this package and its built-in methods, but no other part of a checkout."""
    installed = [place for place in sys.path
                 if Path(place).name in ("site-packages", "dist-packages")]
    # an installed package is next to its dependencies, a checkout's package next to records
    if not (PACKAGE.parent / "pyproject.toml").exists():
        installed.append(str(PACKAGE.parent))
    points = [point for group in _ENTRY_POINTS for point in entry_points(group=group)]
    for package in sorted({point.module.partition(".")[0] for point in points}):
        if (found := find_spec(package)) is not None:
            installed += found.submodule_search_locations or [found.origin or ""]
    places = ["/usr", "/bin", "/lib", "/lib64", "/sys/devices/system/cpu",
              *(f"/etc/{name}" for name in ETC), sys.base_prefix, sys.prefix, sys.exec_prefix,
              *installed, str(PACKAGE), str(PACKAGE.parent / "baselines")]
    return [Path(place) for place in dict.fromkeys(places) if place]


def check_out_of_reach(path: Path, name: str) -> None:
    """Raise ``ValueError`` if workers can read the path, which ``name`` describes."""
    for place in readable_paths():
        if path.resolve().is_relative_to(place.resolve()):
            raise ValueError(f"{name} {path} must lie outside {place}, which isolated methods can "
                             "read")


# -- messages -----------------------------------------------------------------------------------


def encode_message(content: Mapping[str, Any]) -> bytes:
    """Encode named arrays and other values, which must fit for JSON: two lengths, JSON of the
    values and the arrays' layout, and the arrays' bytes."""
    blocks = {name: np.asarray(array, order="C") for name, array in content.items()
              if isinstance(array, np.ndarray)}
    values = {name: value for name, value in content.items() if name not in blocks}
    layout = [[name, _numeric(block.dtype.str), block.shape] for name, block in blocks.items()]
    head = json.dumps([values, layout]).encode()
    body = b"".join(block.tobytes() for block in blocks.values())
    return struct.pack("<QQ", len(head), len(body)) + head + body


def decode_message(read: Callable[[int], bytes]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Decode the values and the arrays of the next message; ``read(n)`` returns exactly n bytes.
    ``ValueError`` if the message is too long or malformed."""
    head_bytes, body_bytes = struct.unpack("<QQ", read(16))
    if head_bytes > MAX_HEADER_BYTES or body_bytes > MAX_ARRAY_BYTES:
        raise ValueError(f"a message must have at most {MAX_HEADER_BYTES} bytes of JSON and "
                         f"{MAX_ARRAY_BYTES} of arrays, got {head_bytes} and {body_bytes}")
    head, body = read(head_bytes), read(body_bytes)
    arrays = {}
    position = 0
    try:
        values, layout = json.loads(head, parse_constant=_numeric)
        _check.depth("values", values)
        json.dumps(values, ensure_ascii=False).encode()  # a lone surrogate cannot be stored
        for name, dtype, shape in layout:
            sizes = [_check.integer("axis", size, low=0, high=MAX_ARRAY_BYTES) for size in shape]
            array = np.frombuffer(body + b"\0" * 8, _numeric(dtype), math.prod(sizes), position)
            arrays[str(name)] = array.reshape(sizes).copy()
            position += array.nbytes
        if position != body_bytes or not isinstance(values, dict):
            raise ValueError("the arrays must fill the message")
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ValueError(f"a message must be JSON and the arrays that it names: {error}") from None
    return values, arrays


def _numeric(dtype: Any) -> str:
    """Return the dtype if it is numeric; numpy would parse others as structures and objects."""
    if not isinstance(dtype, str) or not _NUMERIC_DTYPE.fullmatch(dtype):
        raise ValueError(f"values must be finite in JSON and numeric in arrays, got {dtype!r}")
    return dtype


# -- the parent process -------------------------------------------------------------------------


_started: list[Worker] = []
"""The worker that has a process; only one has, so that methods do not compete for the cores."""


def load_isolated(track: str, id: str, kwargs: str, method: str, isolation: str) -> Method:
    """Load a method, by name or path, for an environment with these arguments (JSON), without
    executing its file in this process; a `Worker` takes the place of its class.

    ``ValueError`` if the file is missing, cannot be loaded, is privileged, or has the name of a
    built-in method.
    """
    path = methods.find_method(method, track)
    sha256 = method_sha256(methods.method_files(path))
    return _load(track, id, kwargs, method, isolation, path, sha256)


def peak_memory() -> int | None:
    """Return the peak memory in bytes of a process of the current worker; None if unknown."""
    family = [pid for worker in _started for pid in worker._family()]
    return max((_status(pid, "VmHWM") for pid in family), default=0) or None


def close() -> None:
    """End the process of the current worker."""
    while _started:
        _started.pop().close()


atexit.register(close)


@cache
def _load(track: str, id: str, kwargs: str, method: str, isolation: str, path: Path,
          sha256: str) -> Method:
    """Load the method from files with this ``sha256``."""
    worker = Worker(track, id, json.loads(kwargs), method, isolation)
    if is_builtin(method):
        loaded = load_method(method, track)
        worker.suits = loaded.suits
        return loaded._replace(make=worker)
    try:
        worker.start()
    except WorkerError as error:
        raise ValueError(f"{path} cannot be loaded: {str(error).removeprefix('ValueError: ')}"
                         ) from None
    about = worker.about
    # a worker may report any name
    name: Any = path.stem if path.suffix == ".py" else about.get("name")
    title = f".{{1,{methods.MAX_TITLE_CHARS}}}"
    for key, value, pattern in (("name", name, r"[^./\\][^/\\]{0,99}"),
                                ("title", about.get("title"), title)):
        if (not isinstance(value, str) or not re.fullmatch(pattern, value)
                or sanitize(value) != value):
            raise ValueError(f"{path} reports an invalid {key}")
    built_in = methods.builtin_files(id).get(name)
    if built_in is not None and methods.builtin_sha256(built_in) != worker.sha256:
        raise ValueError(f"{path} has the name of a built-in method, {name}, under which "
                         "results are stored; rename it")
    loaded = methods.method_from_attributes(track, name, str(path), worker, about)
    if loaded.privileged:
        raise ValueError(f"{path} is privileged; --isolate none gives it the ground truth")
    return loaded._replace(title=about["title"], path=path, sha256=worker.sha256)


class Worker:
    """A process that runs one estimator or policy in one environment, episode after episode.

    ``method`` is the name of a built-in method, or the path of a file, which is read once and
    copied to the folder of the process; the process makes a separate environment. Calls raise
    `WorkerError` if the method fails, and ``ValueError`` if a process under bubblewrap could read
    the cache folder.
    """

    reply_timeout = 600.0
    """s, longest time of a reply"""

    def __init__(self, track: str, id: str, kwargs: dict[str, Any], method: str,
                 isolation: str = "bubblewrap", *, limits: Limits | None = None) -> None:
        self.sha256 = ""
        """hash of the method's files; empty for a built-in method"""
        self.about: dict[str, Any] = {}
        """Unchecked attributes that the method's class reports."""
        self.suits: Callable[[Any], bool] = lambda _: bool(self.about.get("suits"))
        self._name = sanitize(Path(method).stem)
        self._limits = limits or Limits()
        self._is_confined = isolation == "bubblewrap"
        self._deadline = math.inf
        self._process: Any = None
        self._files: dict[str, bytes] = {}
        if is_path(method) and is_builtin(method):
            method = str(Path(method).resolve())
        elif is_path(method):
            self._files = methods.method_files(Path(method))
            self.sha256 = method_sha256(self._files)
            method = Path(method).name
        # registered at run time, which another process does not know
        by_hand = [each for each in runtime_entries() if each.id == id]
        self._meshes = [Path(file) for each in by_hand
                        for file in getattr(each.world.vessel, "files", ())]
        entry = b"".join(map(cloudpickle.dumps, by_hand))
        self._request = {"track": track, "id": id, "kwargs": kwargs, "method": method,
                         "entry": np.frombuffer(entry, np.uint8)}

    def start(self) -> None:
        """Unless it runs, start the process, in place of the process of the current worker."""
        if self.is_alive:
            return
        close()
        self._folder = tempfile.TemporaryDirectory(prefix="eitbench-", ignore_cleanup_errors=True)
        self._home = Path("/tmp" if self._is_confined else self._folder.name)
        place = Path(self._folder.name, "method")
        place.mkdir()
        for name, content in self._files.items():
            (place / name).write_bytes(content)
        command = [sys.executable, "-P", "-c", f"from {__name__} import main; main()",
                   json.dumps(self._limits)]
        if self._is_confined:
            check_out_of_reach(cache_folder(), "the cache folder")
            models = cache_folder() / model_key("", None, 0).folder         # holds no episode
            files = {"/tmp/method": str(place), "/tmp/cache/models": str(models.absolute())}
            # a relative path is relative to the worker's folder /tmp
            files |= {str("/tmp" / path): str(path.absolute()) for path in self._meshes}
            command = [*bubblewrap(self._limits, files), *command]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            start_new_session=True, env=self._environment())
        _started.append(self)
        self._exceeded = ""
        threading.Thread(target=self._watch, args=(self._process,), daemon=True).start()
        try:
            self.about = self._ask("load", **self._request)[0]
        except BaseException:
            self.close()
            raise

    def __call__(self, task: Any, random: np.random.Generator | None = None) -> Worker:
        """Begin an episode with a new instance of the method, like its class; a policy draws from a
        generator with the state of ``random``."""
        self.start()
        self._ask("begin", random=None if random is None else random.bit_generator.state)
        return self

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Any:
        """Return the estimator's `Estimate`, or None, after a measurement."""
        arrays = self._ask("update", voltages=voltages, currents=currents)[1]
        return Estimate(**arrays) if arrays else None

    def covariance_of(self, functionals: np.ndarray) -> np.ndarray | None:
        """Return the estimator's covariance of linear functionals, if it has one."""
        if not self.about.get("has_covariance"):
            return None
        return self._ask("covariance_of", functionals=functionals)[1].get("covariance")

    def act(self, observation: Mapping[str, np.ndarray]) -> Any:
        """Return the policy's action."""
        action = self._ask("act", **observation)[1].get("action", np.zeros(0))
        return int(action) if action.shape == () and action.dtype.kind in "iu" else action

    @property
    def is_alive(self) -> bool:
        """True if the process runs; it ends after a crash, a limit or a malformed message."""
        return self._process is not None and self._process.poll() is None

    def close(self) -> None:
        """End the process and its children, and remove its folder."""
        if self._process is not None:
            _kill(self._process)
            with suppress(OSError):  # data that it has not read
                self._process.stdin.close()
            self._process.stdout.close()
            self._folder.cleanup()

    def _environment(self) -> dict[str, str]:
        """Return the worker's environment variables, without other variables of this process."""
        numeric = {name: value for name, value in os.environ.items()
                   if name.startswith(NUMERIC_ENV)}
        threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        inside = {CACHE_VARIABLE: "/tmp/cache", "NUMBA_CACHE_DIR": "/tmp/kernels"}
        return numeric | threads | {
            "PATH": os.environ.get("PATH", ""), "PYTHONPATH": str(PACKAGE.parent),
            "HOME": str(self._home), "TMPDIR": str(self._home), "PYTHONDONTWRITEBYTECODE": "1",
            CACHE_VARIABLE: str(cache_folder())} | (inside if self._is_confined else {})

    def _ask(self, do: str, **content: Any) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Send a request with the arguments of a method of `_MethodServer`, print the output of the
        worker's method, and return the values and arrays of the reply."""
        self._deadline = time.monotonic() + self.reply_timeout
        try:
            self._process.stdin.write(encode_message({"do": do, **content}))
            self._process.stdin.flush()
            reply, arrays = decode_message(partial(_read_exactly, self._process.stdout))
        except (EOFError, ConnectionError):
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(1.0)
            _kill(self._process)
            raise WorkerError(self._exceeded or "ChildProcessError: the worker ended with status "
                              f"{self._process.returncode}, as after a crash or at a memory limit"
                              ) from None
        except ValueError as error:
            _kill(self._process)
            raise WorkerError(f"ValueError: {error}") from None
        except BaseException:  # a later reply would belong to this request
            _kill(self._process)
            raise
        finally:
            self._deadline = math.inf
        if printed := str(reply.pop("printed", ""))[:MAX_OUTPUT_CHARS].rstrip("\n"):
            lines = sanitize(printed, lines=True).replace("\n", f"\n[{self._name}] ")
            sys.stderr.write(f"[{self._name}] {lines}\n")
        if "error" in reply:
            message, where, traceback = (str(reply.get(name))[:MAX_TEXT_CHARS]
                                         for name in ("error", "where", "traceback"))
            failed = WorkerError(message)
            failed.where, failed.traceback = where, traceback
            raise failed
        return reply, arrays

    def _watch(self, process: subprocess.Popen[bytes]) -> None:
        """Kill the process after the deadline of a reply, or when it and its children have too much
        memory or too many threads."""
        limits = self._limits
        while process.poll() is None:
            family = self._family()
            if time.monotonic() > self._deadline:
                self._exceeded = f"TimeoutError: no reply within {self.reply_timeout:g} s"
            elif sum(_status(pid, "Threads") for pid in family) > limits.threads:
                self._exceeded = (f"ResourceLimitError: it started more than {limits.threads} "
                                  "processes and threads")
            # VmRSS counts a shared page once for each process, Pss, which takes longer, in total
            elif sum(_status(pid, "VmRSS") for pid in family) > limits.memory and sum(
                    _status(pid, "Pss", "smaps_rollup") or _status(pid, "VmRSS")
                    for pid in family) > limits.memory:
                self._exceeded = f"ResourceLimitError: it held more than {limits.memory >> 20} MiB"
            else:
                time.sleep(CHECK_INTERVAL_S)
                continue
            _kill(process)

    def _family(self) -> list[int]:
        """Return the ids of the process and its descendants, not many more than the limit."""
        found: list[int] = []
        left = [self._process.pid]
        while left and len(found) <= self._limits.threads:
            pid = left.pop()
            found.append(pid)
            with suppress(OSError):
                for thread in os.listdir(f"/proc/{pid}/task"):
                    children = Path(f"/proc/{pid}/task/{thread}/children").read_text()
                    left += map(int, children.split())
        return found


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Kill a process and its children; under bubblewrap the kernel ends all processes."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _status(pid: int, field: str, file: str = "status") -> int:
    """Return a number from a file of /proc/PID, a size in bytes; 0 if it is missing."""
    try:
        text = Path(f"/proc/{pid}/{file}").read_text(errors="replace")
    except OSError:
        return 0
    found = re.search(rf"^{field}:\s+(\d+)( kB)?", text, re.MULTILINE)
    return int(found[1]) * (1024 if found[2] else 1) if found else 0


# -- the worker process -------------------------------------------------------------------------


def main() -> None:
    """Serve one method on standard input and output until the parent process closes them."""
    incoming, outgoing = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    null = os.open(os.devnull, os.O_RDWR)
    for stream in range(3):  # printed text must not mix with replies
        os.dup2(null, stream)
    _set_limits(Limits(*json.loads(sys.argv[1])))
    _copy_kernels()
    server = _MethodServer()
    while True:
        sys.stdout = sys.stderr = printed = io.StringIO()
        try:
            values, arrays = decode_message(partial(_read_exactly, incoming))
        except EOFError:
            return
        try:
            reply = getattr(server, values.pop("do"))(**values, **arrays)
            message = encode_message(reply | {"printed": _sendable(printed.getvalue())})
        except (Exception, SystemExit) as error:
            message = encode_message(server.describe(error)
                                     | {"printed": _sendable(printed.getvalue())})
        outgoing.write(message)
        outgoing.flush()


def _read_exactly(stream: Any, n: int) -> bytes:
    content = bytes(stream.read(n))
    if len(content) < n:
        raise EOFError
    return content


def _set_limits(limits: Limits) -> None:
    """Limit address space, file size and open files, and end this process with its parent."""
    import resource  # not on Windows
    most = {resource.RLIMIT_AS: limits.memory, resource.RLIMIT_FSIZE: limits.disk,
            resource.RLIMIT_NOFILE: 1024, resource.RLIMIT_CORE: 0}
    if os.environ["HOME"] == "/tmp":  # outside the sandbox all processes of the user would count
        most[resource.RLIMIT_NPROC] = limits.threads
    for kind, value in most.items():
        resource.setrlimit(kind, (value, value))
    if sys.platform.startswith("linux"):
        PR_SET_PDEATHSIG = 1
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


def _copy_kernels() -> None:
    """Copy compiled kernels to the folder in which numba expects them; compiling takes 20 s."""
    if "NUMBA_CACHE_DIR" not in os.environ:
        return
    source = PACKAGE / "numerics"
    name = f"{source.name}_{hashlib.sha1(str(source).encode()).hexdigest()}"
    place = Path(os.environ["NUMBA_CACHE_DIR"]) / name
    place.mkdir(parents=True)
    for path in (source / "__pycache__").glob("*.nb?"):
        shutil.copy2(path, place)


class _MethodServer:
    """Requests that a worker answers; each method returns the content of a reply."""

    _file = Path()
    _method: Any
    _known: Any
    _instance: Any

    def load(self, track: str, id: str, kwargs: dict[str, Any], method: str,
             entry: np.ndarray) -> dict[str, Any]:
        """Load the method and return the attributes of its class."""
        import gymnasium as gym
        if entry.size:  # unpickling is safe: the parent process sent it
            import_entries([cloudpickle.loads(entry.tobytes())])
        env: Any = gym.make(id, disable_env_checker=True, **kwargs).unwrapped
        self._file = Path.home() / "method" / method
        self._method = load_method(str(self._file) if self._file.is_file() else method, track)
        self._known = env.task if track == "estimation" else env.rules
        attributes = ("name", "title", "subtracks", "parameters", "role", "privileged")
        about = {name: getattr(self._method, name) for name in attributes}
        return about | {"suits": self._method.suits(self._known),
                        "has_covariance": hasattr(self._method.make, "covariance_of")}

    def begin(self, random: dict[str, Any] | None) -> dict[str, Any]:
        """Make a new instance of the method."""
        drawn = [] if random is None else [generator_from_state(random)]
        self._instance = self._method.make(self._known, *drawn)
        return {}

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> dict[str, Any]:
        """Return the estimator's estimate after a measurement."""
        estimate = self._instance.update(voltages, currents)
        if estimate is None:
            return {}
        if not isinstance(estimate, Estimate):
            raise ValueError("Estimator.update must return an Estimate or None, got "
                             f"{type(estimate).__name__}")
        return {name: np.asarray(value) for name, value in estimate._asdict().items()
                if value is not None}

    def covariance_of(self, functionals: np.ndarray) -> dict[str, Any]:
        """Return the estimator's covariance of linear functionals, if it has one now."""
        known = self._instance.covariance_of(functionals)
        return {} if known is None else {"covariance": np.asarray(known)}

    def act(self, **observation: np.ndarray) -> dict[str, Any]:
        """Return the policy's action."""
        return {"action": np.asarray(self._instance.act(observation))}

    def describe(self, error: BaseException) -> dict[str, str]:
        """Return an error as the header of a reply."""
        message = f"{type(error).__name__}: {error}".replace(f"{self._file.parent}/", "")
        found = {"error": message, "where": error_location(error, self._file),
                 "traceback": user_traceback(error, self._file)}
        return {key: _sendable(value) for key, value in found.items()}


def _sendable(text: str) -> str:
    """Truncate a text, and replace lone surrogates, which UTF-8 cannot encode."""
    return text[:MAX_OUTPUT_CHARS].encode(errors="replace").decode()
