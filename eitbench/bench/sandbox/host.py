"""Run somebody else's estimator or policy in a process of its own: `Guest`. What passes between is
measured numbers.

``docs/sandbox.md`` says what this protects against, ``docs/trust.md`` what not.
"""

from __future__ import annotations

import hashlib
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import cloudpickle
import numpy as np

from eitbench._files import PACKAGE
from eitbench.bench.methods import is_ours, is_path
from eitbench.bench.prints import Prints
from eitbench.bench.sandbox import keeper, wire
from eitbench.bench.sandbox.keeper import Limits
from eitbench.data.store import CACHE_VARIABLE, cache_folder, folder, kinds
from eitbench.worlds.registry import entry, registered_by_hand

PATIENCE = 600.0
"""s that an answer may take; the first after an episode began may hold all preparations"""
ENDURANCE = 6 * 3600.0
"""s that all answers of an episode may take together; else one answer after the other could take
nearly `PATIENCE`"""
END = 10.0
"""s that its keeper may take to end it"""
MODELS = ("outline.npz", "region.npz", "reduced-*.npz", "joint-*.npz")
"""What the cache holds of a world, made without any episode; the files of an episode begin with its
seed."""
_LIMITS = Limits()
_LONGEST_WORD = 1000
"""bytes that a keeper says at most"""
ARITHMETIC = ("OPENBLAS_", "MKL_", "OMP_", "NPY_", "NUMBA_CPU")
"""Variables on which the last bits of numbers depend begin so."""


class GuestError(RuntimeError):
    """The guest raised an exception, broke a limit, or does not speak the language."""

    where: str = "guest"
    traceback: str = ""
    """The lines of the method's own code that led to it."""


class Guest:
    """A process that plays one estimator or policy in one environment, episode after episode.

    Parameters
    ----------
    track : "estimation" or "injection"
        Whether it is an estimator or a policy.
    id, kwargs
        The environment, of which it makes its own, without an episode.
    name : str
        One of ours, or the path of a .py file or an agent's model.zip. A file that is not ours is
        copied into a folder of the guest's own, which is the only place where it can write.
    limits : Limits
        What it may take, together with all that it starts.
    patience : float
        s

    Raises
    ------
    GuestError
        If the method cannot be loaded.
    ValueError
        If the cache folder lies where the guest can read.
    """

    def __init__(self, track: str, id: str, kwargs: dict[str, Any], name: str, *,
                 limits: Limits = _LIMITS, patience: float = PATIENCE) -> None:
        self._patience = patience
        self._left = ENDURANCE
        """s that answers may still take in this episode"""
        self._prints = Prints(name)
        self._printed = 0
        """letters that it has printed in this episode"""
        self.sha256 = ""
        """Of the file that was copied; empty for one of ours."""
        self._private = Path(tempfile.mkdtemp(prefix="eitbench-guest-"))
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-P", keeper.__file__, str(self._private), *map(str, limits)],
                # a terminal can be typed into; at the end the keeper says what was too much
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                start_new_session=True, env=self._surroundings(id, kwargs), cwd=self._private)
        except BaseException:
            keeper.remove(str(self._private))
            raise
        try:
            assert self._process.stdin is not None
            os.set_blocking(self._process.stdin.fileno(), False)
            wall = self._receive()[0]  # no stranger's word yet
            self.walls: list[str] = wall["walls"]
            """What keeps it where it is: its own namespaces, Landlock, seccomp, no capabilities."""
            self.process = int(wall["process"])
            """The number of the process that plays."""
            self.closed = "landlock" in self.walls
            """Whether files are out of its reach."""
            if self.closed:
                _refuse_open_cache(wall["readable"])
            self.about = self._ask({"do": "play", "track": track, "id": id, "kwargs": kwargs,
                                    "name": self._copied(name)}, {"told": _told(id)})[0]
            """What the method's class says of itself: unchecked words of a stranger."""
        except BaseException:
            self.close()
            raise

    def begin(self, random: np.random.Generator | None = None) -> None:
        """A new episode: another estimator or policy, of the same class; a policy's generator
        draws what this one would."""
        self._left = ENDURANCE
        self._printed = 0
        state = None if random is None else random.bit_generator.state
        self._ask({"do": "begin", "random": state})

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Any:
        """What the estimator makes of a measurement: an `Estimate` or None."""
        from eitbench.worlds.task import Estimate
        words, arrays = self._ask({"do": "update"}, {"voltages": voltages, "currents": currents})
        if words.get("estimate") is None:
            return None
        if words["estimate"] != "Estimate":
            raise GuestError("ValueError: Estimator.update must return an Estimate or None, got "
                             f"{_plain(words['estimate'])}")
        if not {"mean"} <= set(arrays) <= set(Estimate._fields):
            raise GuestError(f"ValueError: Estimator.update must return an Estimate, got one of "
                             f"{_plain(', '.join(arrays))}")
        return Estimate(**arrays)

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        """The policy's action."""
        action = self._ask({"do": "act"}, observation)[1].get("action", np.zeros(0))
        return int(action) if action.shape == () and action.dtype.kind in "iu" else action

    @property
    def alive(self) -> bool:
        """Whether it can be asked: not after a crash, nonsense, or an answer that did not come in
        time."""
        return self._process.poll() is None

    @property
    def peak_memory(self) -> int | None:
        """bytes that it has held at most; None where that is not told."""
        try:
            status = Path(f"/proc/{self.process}/status").read_text(errors="replace")
        except OSError:
            return None
        return next((1024 * int(line.split()[1]) for line in status.splitlines()
                     if line.startswith("VmHWM")), None)

    def close(self) -> None:
        """End it and its children, and remove its folder."""
        self._end()
        self._prints.end()
        for pipe in (self._process.stdin, self._process.stdout, self._process.stderr):
            if pipe:
                pipe.close()
        keeper.remove(str(self._private))

    def __enter__(self) -> Guest:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()

    def _surroundings(self, id: str, kwargs: dict[str, Any]) -> dict[str, str]:
        """Environment variables; models that are kept in the cache, without a truth, are copied for
        the guest."""
        cache = self._private / "cache"
        kernels = self._private / "kernels"
        there = folder(entry(id).world.changed(kwargs.get("world")))
        (cache / there.name).mkdir(parents=True)
        for model in (path for pattern in MODELS for path in there.glob(pattern)):
            if model.is_file():
                shutil.copy(model, cache / there.name)
        _copy_kernels(kernels)
        package = PACKAGE.parent
        arithmetic = {name: value for name, value in os.environ.items()
                      if name.startswith(ARITHMETIC)}
        return arithmetic | {
            "PATH": os.environ.get("PATH", ""),
            "HOME": str(self._private),
            "TMPDIR": str(self._private),
            "PYTHONPATH": str(package),
            "PYTHONDONTWRITEBYTECODE": "1",
            "NUMBA_CACHE_DIR": str(kernels),
            CACHE_VARIABLE: str(cache),
        } | dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")

    def _copied(self, name: str) -> str:
        if not is_path(name):
            return name
        if is_ours(name):  # a copy would pass for a stranger's that has taken our name
            return str(Path(name).resolve())
        path = Path(name)
        place = self._private / "own"
        place.mkdir()
        beside: Sequence[str] = ("config.json", "sha256") if path.suffix == ".zip" else ()
        for each in (path, *(path.with_name(other) for other in beside)):
            if each.exists():
                shutil.copy(each, place)
        self.sha256 = hashlib.sha256((place / path.name).read_bytes()).hexdigest()
        return str(place / path.name)

    def _ask(self, words: dict[str, Any], arrays: dict[str, np.ndarray] | None = None,
             ) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        begin = time.monotonic()
        try:
            self._send(wire.pack(words, arrays))
            answer = self._receive()
            self._left -= time.monotonic() - begin
            if self._left < 0.0:
                raise GuestError("TimeoutError: its answers in one episode took more than "
                                 f"{ENDURANCE:g} s")
        except BaseException:  # whatever it says from now on would answer another question
            self._end()
            raise
        self._pass_on(str(answer[0].pop("printed", "")))
        if "error" in answer[0]:
            own = f"{self._private}{os.sep}own{os.sep}"
            error = GuestError(_plain(answer[0]["error"]).replace(own, ""))
            error.where = _plain(answer[0].get("where"))
            error.traceback = _plain(answer[0].get("traceback"))
            raise error
        return answer

    def _pass_on(self, printed: str) -> None:
        """Show what it has printed since its last answer, as long as that is not too much."""
        shown = printed[:max(0, wire.PRINTED - self._printed)]
        if len(shown) < len(printed) and self._printed <= wire.PRINTED:
            shown += f"\n… more than {wire.PRINTED} letters in an episode are not shown\n"
        self._printed += len(printed)
        self._prints.write(shown)

    def _send(self, message: bytes) -> None:
        assert self._process.stdin is not None
        pipe = self._process.stdin.fileno()
        deadline = time.monotonic() + self._patience
        left = memoryview(message)
        while left:                                    # a pipe that nobody reads is full some time
            if not select.select([], [pipe], [], max(0.0, deadline - time.monotonic()))[1]:
                raise GuestError("TimeoutError: a question was not read within "
                                 f"{self._patience:g} s")
            try:
                left = left[os.write(pipe, left):]
            except BrokenPipeError:
                raise self._ended() from None

    def _receive(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        assert self._process.stdout is not None
        pipe = self._process.stdout.fileno()
        deadline = time.monotonic() + self._patience

        def read(n: int) -> bytes:
            parts = []
            left = n
            while left:
                if not select.select([pipe], [], [], max(0.0, deadline - time.monotonic()))[0]:
                    raise GuestError(f"TimeoutError: no answer within {self._patience:g} s")
                part = os.read(pipe, min(left, 1 << 20))
                if not part:
                    raise self._ended()
                parts.append(part)
                left -= len(part)
            return b"".join(parts)

        try:
            return wire.unpack(read)
        except ValueError as error:
            raise GuestError(f"ValueError: {error}") from None

    def _ended(self) -> GuestError:
        status = self._end()
        assert self._process.stderr is not None
        os.set_blocking(self._process.stderr.fileno(), False)
        if said := self._process.stderr.read(_LONGEST_WORD):
            return GuestError(f"ResourceLimitError: it took {said.decode(errors='replace')}")
        return GuestError(f"ChildProcessError: its process ended with status {status}, which "
                          "is what a crash does, or a limit of memory")

    def _end(self) -> int:
        """Have it and all its descendants killed; its status."""
        self._process.send_signal(keeper.ASKED)
        try:
            return self._process.wait(END)
        except subprocess.TimeoutExpired:
            self._process.kill()  # the guest ends with it
            return self._process.wait()


def _told(id: str) -> np.ndarray:
    """An entry that a guest does not know by itself, since a script registered it, as bytes; else
    none.

    What is unpickled there comes from here; nothing of a guest is ever unpickled here.
    """
    if id not in [each.id for each in registered_by_hand()]:
        return np.zeros(0, np.uint8)
    # Parts of parts, and the classes that they descend from, may stand in files of their own.
    names = {kind.__module__ for kind in kinds(entry(id).world)}
    known = {"eitbench", *sys.stdlib_module_names}
    modules = [sys.modules[name] for name in sorted(names & set(sys.modules))
               if name.partition(".")[0] not in known]
    for module in modules:  # a guest has not the script's folder
        cloudpickle.register_pickle_by_value(module)
    try:
        return np.frombuffer(cloudpickle.dumps(entry(id)), np.uint8)
    finally:
        for module in modules:
            cloudpickle.unregister_pickle_by_value(module)


def _refuse_open_cache(readable: list[str]) -> None:
    """``ValueError`` if the truths of episodes are kept in one of these places or beneath."""
    cache = cache_folder().resolve()
    for place in readable:
        if cache.is_relative_to(Path(place).resolve()):
            raise ValueError(f"the cache folder {cache} lies in {place}, which guests may read; "
                             "let $EITBENCH_CACHE name another")


def _plain(said: Any) -> str:
    """What a guest said, as text that can be kept anywhere."""
    return str(said)[:2000]


def _copy_kernels(place: Path) -> None:
    """numba's compiled kernels, where it will look for them: compiling takes some 20 s."""
    folder = PACKAGE / "numerics"
    there = place / f"{folder.name}_{hashlib.sha1(str(folder).encode()).hexdigest()}"
    there.mkdir(parents=True)
    for path in (folder / "__pycache__").glob("*.nb?"):
        shutil.copy2(path, there)
