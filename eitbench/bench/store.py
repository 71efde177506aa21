"""Results on disk: one file an episode, replaced atomically; records are gathered from them."""

from __future__ import annotations

import io
import json
import os
import platform
import subprocess
import time
import warnings
from collections.abc import Iterable, Iterator
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from eitbench._code import code_digest, package_files
from eitbench._files import PACKAGE, write_atomically
from eitbench.bench.records import SCHEMA, SHARED, read_records, sealed, split_of, write_record
from eitbench.data.seeds import name_seed

PACKAGES = ("eitbench", "numpy", "scipy", "gymnasium", "scikit-fem", "numba", "stable-baselines3", "sb3-contrib",
            "torch")
"""Whose versions a record names."""
_NEEDED = {"identity", "seed", "method", "environment", "finished", "status", "run", *SHARED}


class EpisodeStore:
    """The folder of a run: ``episodes/ENV/METHOD/SEED.json`` with its estimates in ``SEED.npz``
    beside it.

    Every file is written whole or not at all, so runs may share a folder and may be interrupted
    anywhere.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder).absolute()           # worker processes may stand elsewhere

    def put(self, environment: str, method: str, seed: int, result: dict[str, Any],
            fields: dict[str, np.ndarray]) -> None:
        """Store one episode; the estimates first, so that a result never stands without them."""
        path = self._path(environment, method, seed)
        if fields:
            content = io.BytesIO()
            np.savez_compressed(content, **fields)  # type: ignore[arg-type]
            write_atomically(path.with_suffix(".npz"), content.getvalue())
        write_atomically(path, json.dumps(result, indent=1, allow_nan=False).encode())

    def holds(self, environment: str, method: str, seed: int, identity: str) -> bool:
        """Whether a successful result of exactly this identity is there."""
        result = _read(self._path(environment, method, seed))
        return result is not None and result["identity"] == identity and result["status"] == "ok"

    def results(self) -> Iterator[dict[str, Any]]:
        """All stored results; files that cannot be read are passed over."""
        paths = self.folder.glob("episodes/*/*/*.json")
        for path in sorted(paths):
            result = _read(path)
            if result is not None:
                yield result

    def fields(self, result: dict[str, Any]) -> dict[str, np.ndarray]:
        """The estimates that belong to a result: ``mean`` and perhaps ``std``, (T, n) in mol/m³."""
        folder = self.folder / "episodes" / result["environment"]["name"] / result["method"]
        with np.load(folder / f"{result['seed'].replace(':', '-')}.npz", allow_pickle=False) as stored:
            return dict(stored)

    def records(self, also: Iterable[dict[str, Any]] = ()) -> list[dict[str, Any]]:
        """The episodes, gathered into one record per environment, method and split of the seeds;
        not checked yet.

        Of what lies here only results of the latest run's code count, so that nothing stale is
        taken for new. ``also`` are results of records: where they are of the same version of the
        method, they fill in what is missing here or failed.
        """
        own, others = _by_record(self.results()), _by_record(also)
        records = []
        for key in dict.fromkeys([*own, *others]):
            fresh = _of_one_code(own.get(key, []))
            version = max(fresh or others[key], key=lambda result: result["finished"])["version"]
            records.append(_gathered([*fresh, *(each for each in others.get(key, []) if each["version"] == version)]))
        return records

    def write_records(self) -> list[dict[str, Any]]:
        """Write the `records` into ``records/`` and return them.

        One that is not valid is left out with a warning: what a method claimed there is no obstacle
        for the others.
        """
        written = []
        for record in self.records():
            try:
                write_record(self.folder / "records", record)
            except ValueError as error:
                warnings.warn(f"left out: {error}", stacklevel=2)
            else:
                written.append(record)
        return written

    def _path(self, environment: str, method: str, seed: int) -> Path:
        name = f"{name_seed(seed).replace(':', '-')}.json"
        return self.folder / "episodes" / environment.replace("/", "-") / method / name


def _by_record(results: Iterable[dict[str, Any]]) -> dict[tuple[str, str, str], list[dict[str, Any]]]:
    """Results that may stand in one record: of an environment, a method and a split."""
    groups: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for result in results:
        key = (result["environment"]["name"], result["method"], split_of(result["seed"]))
        groups.setdefault(key, []).append(result)
    return groups


def _of_one_code(results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Those of the library and the method's file that ran last."""
    codes = [(result["run"]["source"], result["method_sha256"]) for result in results]
    if not codes:
        return []
    latest = max(range(len(results)), key=lambda k: results[k]["finished"])
    return [result for result, code in zip(results, codes, strict=True) if code == codes[latest]]


def _gathered(results: list[dict[str, Any]]) -> dict[str, Any]:
    """The record of one version's episodes, self-reported; of several results of a seed the first
    successful one."""
    latest = max(results, key=lambda result: result["finished"])
    chosen: dict[str, dict[str, Any]] = {}
    for result in results:
        if chosen.setdefault(result["seed"], result)["status"] != "ok":
            chosen[result["seed"]] = result
    # 9 before 10
    results = sorted(chosen.values(), key=lambda result: (len(result["seed"]), result["seed"]))
    runs: list[dict[str, Any]] = []
    for result in results:
        if result["run"] not in runs:
            runs.append(result["run"])
    apart = {*SHARED, "environment", "method", "run"}
    return sealed({
        "schema": SCHEMA, **{key: latest[key] for key in ("environment", "method", *SHARED)}, "official": False,
        "split": split_of(latest["seed"]), "seeds": [result["seed"] for result in results], "runs": runs,
        "episodes": [{key: value for key, value in result.items() if key not in apart}
                     | {"run": runs.index(result["run"])} for result in results],
    })


def results_of(record: dict[str, Any]) -> list[dict[str, Any]]:
    """The results that were gathered into a record, as a store would hold them."""
    shared = {key: record[key] for key in ("environment", "method", *SHARED)}
    return [episode | shared | {"run": record["runs"][episode["run"]]} for episode in record["episodes"]]


def results_in(folder: Path) -> list[dict[str, Any]]:
    """The results that were gathered into the records of a folder. Errors as
    `records.read_records`."""
    return [result for record in read_records(folder) for result in results_of(record)]


def _read(path: Path) -> dict[str, Any] | None:
    result = _read_json(path)
    return result if result is not None and result.keys() >= _NEEDED else None


def _read_json(path: Path) -> dict[str, Any] | None:
    try:
        result = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return result if isinstance(result, dict) else None


@lru_cache(maxsize=1)
def source_digest() -> str:
    """Hash of the code that scores depend on: stored results of other code are played again, and a
    record says of each run which it was."""
    rooms = ("numerics/*", "physics/*", "worlds/*", "data/*", "estimation/**/*", "scoring", "envs/*", "rl/networks",
             "rl/agents", "bench/run", "bench/score", "bench/policies")
    return code_digest(package_files(*(f"{room}.py" for room in rooms)))


@lru_cache(maxsize=1)
def provenance() -> dict[str, Any]:
    """Versions and commit of the code that this process runs."""
    # results, not code
    status = _git("--no-optional-locks", "status", "--porcelain", "--", ".", ":!leaderboards")
    blas = np.show_config(mode="dicts")["Build Dependencies"]["blas"]  # type: ignore[index,call-overload]
    return {
        "versions": {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}},
        "blas": f"{blas['name']} {blas['version']}",
        "commit": _git("rev-parse", "HEAD"), "dirty": None if status is None else bool(status),
        "source": source_digest(),
    }


@lru_cache(maxsize=1)
def machine() -> dict[str, Any]:
    """The machine of this process: in a cluster, another one than that of whoever started the run."""
    return {"processor": _processor(), "cores": os.cpu_count(), "system": platform.system(), "blas_threads": 1,
            "matmul_seconds": matmul_seconds()}


@lru_cache(maxsize=1)
def matmul_seconds() -> float:
    """Time of a 1000 × 1000 × 1000 matrix product in double precision on one thread here, in s: the
    median of three.

    In units of it, times of different machines can be compared.
    """
    a, b = np.random.default_rng(0).normal(size=(2, 1000, 1000))
    times = []
    with threadpool_limits(1):
        for _ in range(3):
            begin = time.perf_counter()
            a @ b
            times.append(time.perf_counter() - begin)
    return float(np.median(times))


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _git(*arguments: str) -> str | None:
    checkout = PACKAGE.parent
    if not (checkout / ".git").exists():  # installed: a repository around it is somebody else's
        return None
    try:
        done = subprocess.run(["git", *arguments], cwd=checkout, capture_output=True, text=True,
                              timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
