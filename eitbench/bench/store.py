"""Episode store: one file per method and episode of a run, from which records are built."""

from __future__ import annotations

import json
import os
import platform
import re
import shlex
import subprocess
import timeit
import warnings
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from eitbench._files import PACKAGE, atomic_path, write_atomically
from eitbench._sanitize import sanitize
from eitbench.bench import records as stored
from eitbench.bench.scores import SCORING
from eitbench.data.cache import SIMULATION
from eitbench.data.seeds import format_seed

PACKAGES = ("eitbench", "numpy", "scipy", "gymnasium", "scikit-fem", "numba", "stable-baselines3",
            "sb3-contrib", "torch")
"""Packages whose versions are part of a record."""
DECLARED_VERSIONS = {"simulation": str(SIMULATION), "scoring": str(SCORING)}
"""Version numbers that developers raise when a change of the code changes scores of an episode."""
_OPTION = re.compile(r"^(--?[\w-]+=|-[a-z])")
"""Name of an option that is joined to its value."""


class EpisodeStore:
    """Episode results of a run in a folder: ``episodes/ENV/METHOD/SEED.json``, with the estimates
    in ``SEED.npz``. Files are written atomically, so several runs may share a folder and may be
    interrupted at any time."""

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder).absolute()           # workers may have other working folders

    def put(self, result: dict[str, Any], fields: dict[str, np.ndarray]) -> None:
        """Store the ``result`` of one episode, and before it the estimates ``fields``."""
        path = self._path(result["environment"]["name"], result["method"], result["seed"])
        if fields:
            with atomic_path(path.with_suffix(".npz")) as temporary, temporary.open("wb") as file:
                np.savez_compressed(file, **fields)  # type: ignore[arg-type]
        write_atomically(path, json.dumps(result, indent=1, allow_nan=False).encode())

    def has_result(self, environment: str, method: str, seed: int, identity: str) -> bool:
        """Return whether a successful result with the cache key ``identity`` is stored."""
        with suppress(ValueError):
            result = self.result(environment, method, seed)
            return bool(result["identity"] == identity and result["status"] == "ok")
        return False

    def result(self, environment: str, method: str, seed: int) -> dict[str, Any]:
        """Return a stored result; ``ValueError`` if it is missing or damaged."""
        return _read(self._path(environment, method, format_seed(seed)))

    def results(self) -> Iterator[dict[str, Any]]:
        """Yield all stored results; a damaged file is skipped with a warning that names it."""
        for path in sorted(self.folder.glob("episodes/*/*/*.json")):
            try:
                yield _read(path)
            except ValueError as error:
                warnings.warn(f"{sanitize(str(path))} is left out: it {error}", stacklevel=2)

    def traceback(self, record: dict[str, Any], seed: str) -> str:
        """Return the traceback of a failed episode of a record, restricted to the method's file;
        empty if it is not stored."""
        path = self._path(record["environment"]["name"], record["method"], seed)
        with suppress(ValueError):
            return str(_read(path).get("traceback", ""))
        return ""

    def fields(self, result: dict[str, Any]) -> dict[str, np.ndarray]:
        """Read the estimates of a result: ``mean`` and optionally ``std``, (T, n) in mol/m³ for T
        states and n nodes; ``std`` is NaN in states without a variance. ``FileNotFoundError`` if
        the file is missing; ``ValueError``, naming it, if it is damaged."""
        path = self._path(result["environment"]["name"], result["method"], result["seed"])
        path = path.with_suffix(".npz")
        try:
            with np.load(path, allow_pickle=False) as archive:
                fields = dict(archive)
        except FileNotFoundError:
            raise
        # a damaged archive may raise zlib.error, NotImplementedError, RuntimeError, …
        except Exception as error:
            raise ValueError(f"estimates {path} cannot be read: {error}") from None
        if "mean" not in fields or not all(
                each.ndim == 2 and each.dtype.kind == "f" and not np.isinf(each).any()
                for each in fields.values()) or np.isnan(fields["mean"]).any():
            raise ValueError(f"estimates {path} must hold finite numbers (T, n) named mean")
        return fields

    def records(self, also: Iterable[dict[str, Any]] = ()) -> list[dict[str, Any]]:
        """Build one record per environment, method and split of the seeds, without validation.

        Stored results are ignored if their method's file or `DECLARED_VERSIONS` differ from the
        most recent result. ``also`` are results of other records, which replace missing and failed
        episodes of the same version of the method.
        """
        own, others = (stored.group_by(each, _record_key) for each in (self.results(), also))
        records = []
        for key in dict.fromkeys([*own, *others]):
            fresh = own.get(key, [])
            code = _code(_latest(fresh)) if fresh else ()
            fresh = [result for result in fresh if _code(result) == code]
            version = _latest(fresh or others[key])["version"]
            known = [each for each in others.get(key, []) if each["version"] == version]
            records.append(_gathered([*fresh, *known]))
        return records

    def write_records(self) -> list[dict[str, Any]]:
        """Write the valid `records` into the folder ``records`` and return them; an invalid record
        is skipped with a warning."""
        written = []
        for record in self.records():
            try:
                stored.write_record(self.folder / "records", record)
            except ValueError as error:
                warnings.warn(f"left out: {error}", stacklevel=2)
            else:
                written.append(record)
        return written

    def _path(self, environment: str, method: str, seed: str) -> Path:
        name = f"{seed.replace(':', '-')}.json"
        return self.folder / "episodes" / environment.replace("/", "-") / method / name


def _record_key(result: dict[str, Any]) -> tuple[str, str, str]:
    """Return environment, method and split, which all results of a record share."""
    return result["environment"]["name"], result["method"], stored.split_of(result["seed"])


def _latest(results: list[dict[str, Any]]) -> dict[str, Any]:
    return max(results, key=lambda result: result["finished"])


def _code(result: dict[str, Any]) -> tuple[Any, ...]:
    """Return the sha256 of the method's file, and the declared versions."""
    versions = result["run"]["versions"]
    return result["method_sha256"], *map(versions.get, DECLARED_VERSIONS)


def _gathered(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Build a self-reported record from results of one version of a method; if a seed has several
    results, the first successful one is used."""
    latest = _latest(results)
    chosen: dict[str, dict[str, Any]] = {}
    for result in results:
        if chosen.setdefault(result["seed"], result)["status"] != "ok":
            chosen[result["seed"]] = result
    # sort 9 before 10
    results = sorted(chosen.values(), key=lambda result: (len(result["seed"]), result["seed"]))
    runs: list[dict[str, Any]] = []
    for result in results:
        if result["run"] not in runs:
            runs.append(result["run"])
    return stored.with_content_hash({
        "schema": stored.SCHEMA, "official": False, "split": stored.split_of(latest["seed"]),
        **{key: latest[key] for key in stored.COMMON_FIELDS},
        "seeds": [result["seed"] for result in results], "runs": runs,
        "episodes": [{key: value for key, value in result.items()
                      if key not in (*stored.COMMON_FIELDS, "traceback")}
                     | {"run": runs.index(result["run"])} for result in results],
    })


def record_results(record: dict[str, Any]) -> list[dict[str, Any]]:
    """Convert a record to episode results, as `EpisodeStore.results` yields them."""
    shared = {key: record[key] for key in stored.COMMON_FIELDS if key in record}
    runs = record.get("runs", [])
    return [episode | shared | ({"run": runs[episode["run"]]} if runs else {})
            for episode in record["episodes"]]


def folder_results(folder: Path) -> list[dict[str, Any]]:
    """Return the episode results of all records in a folder; errors as in `read_records`."""
    return [result for record in stored.read_records(folder) for result in record_results(record)]


def _read(path: Path) -> dict[str, Any]:
    """Read a result; ``ValueError`` if it is damaged or does not yield a valid record, with a
    message that does not name the file."""
    result = stored.read_json(path)
    try:
        stored.check_record(_gathered([result]))
    except (AttributeError, KeyError, TypeError) as error:
        raise ValueError(f"is not an episode result: {type(error).__name__}: {error}") from None
    return result  # type: ignore[no-any-return]


# -- the code and the machine of a run ----------------------------------------------------------


@lru_cache(maxsize=1)
def provenance() -> dict[str, Any]:
    """Return package versions, BLAS library, git commit, and whether the checkout has changes."""
    # changes in `leaderboards` do not count: it holds results
    status = _git("--no-optional-locks", "status", "--porcelain", "--", ".", ":!leaderboards")
    config: Any = np.show_config(mode="dicts")  # type: ignore[call-overload]
    blas = config["Build Dependencies"]["blas"]
    packages = {name: _version(name) for name in PACKAGES}
    return {
        "versions": {"python": platform.python_version(), **packages, **DECLARED_VERSIONS},
        "blas": f"{blas['name']} {blas['version']}",
        "commit": _git("rev-parse", "HEAD"), "dirty": None if status is None else bool(status),
    }


def portable_command(command: str) -> str:
    """Return a command without the folders of the machine: paths that are absolute or contain
    ``..``, also those behind ``--option=`` or ``-o``, are reduced to their last component."""
    words = (_OPTION.split(word, maxsplit=1) for word in shlex.split(command))
    return shlex.join("".join(each[:-1]) + _portable(each[-1]) for each in words)


def _portable(word: str) -> str:
    path = Path(word)
    return path.name if path.is_absolute() or ".." in path.parts else word


@lru_cache(maxsize=1)
def machine() -> dict[str, Any]:
    """Return processor, number of cores, operating system and speed of the machine of this process.

    The speed, which makes computing times comparable, is the time in s of a product of two 1000 ×
    1000 matrices in double precision on one thread (median of three).
    """
    a, b = np.random.default_rng(0).normal(size=(2, 1000, 1000))
    with threadpool_limits(1):
        seconds = timeit.repeat(lambda: a @ b, number=1, repeat=3)
    return {"processor": _processor(), "cores": os.cpu_count(), "system": platform.system(),
            "blas_threads": 1, "matmul_seconds": float(np.median(seconds))}


def _version(package: str) -> str | None:
    with suppress(PackageNotFoundError):
        return version(package)
    return None


def _git(*arguments: str) -> str | None:
    checkout = PACKAGE.parent
    if not (checkout / ".git").exists():  # installed: an enclosing repository is unrelated
        return None
    with suppress(OSError, subprocess.SubprocessError):
        return subprocess.run(["git", *arguments], cwd=checkout, capture_output=True, text=True,
                              timeout=10, check=True).stdout.strip()
    return None


def _processor() -> str:
    with suppress(OSError):
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
        if named := re.search(r"^model name[^:\n]*:(.*)", text, re.MULTILINE):
            return named[1].strip()
    return platform.processor() or platform.machine()
