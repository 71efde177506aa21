"""Results on disk: one file an episode, replaced atomically; records are gathered from them."""

from __future__ import annotations

import io
import json
import os
import platform
import re
import subprocess
import timeit
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
from eitbench._foreign import cleaned
from eitbench.bench.records import SCHEMA, SHARED, read_records, sealed, split_of, write_record
from eitbench.bench.strict_json import parsed
from eitbench.data.seeds import name_seed

PACKAGES = ("eitbench", "numpy", "scipy", "gymnasium", "scikit-fem", "numba", "stable-baselines3",
            "sb3-contrib", "torch")
"""Whose versions a record names."""
_OF_ALL = ("environment", "method", *SHARED)
"""What the results that make one record have in common."""
_HERE = ("traceback",)
"""What a result says for its user, and a record does not."""
_NEEDED = {"identity", "seed", "finished", "status", "run", *_OF_ALL}
_TEXTS = ("identity", "seed", "finished", "status", "method", "title", "board", "version",
          "method_sha256")


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
        path = self._path(environment, method, name_seed(seed))
        if fields:
            content = io.BytesIO()
            np.savez_compressed(content, **fields)  # type: ignore[arg-type]
            write_atomically(path.with_suffix(".npz"), content.getvalue())
        write_atomically(path, json.dumps(result, indent=1, allow_nan=False).encode())

    def holds(self, environment: str, method: str, seed: int, identity: str) -> bool:
        """Whether a successful result of exactly this identity is there."""
        result = _read(self._path(environment, method, name_seed(seed)))
        return result is not None and result["identity"] == identity and result["status"] == "ok"

    def results(self) -> Iterator[dict[str, Any]]:
        """All stored results; a file that is none is passed over with a warning that names it."""
        for path in sorted(self.folder.glob("episodes/*/*/*.json")):
            if result := _read(path):
                yield result
            else:
                warnings.warn(f"{cleaned(str(path))} is left out: it is no result of an episode",
                              stacklevel=2)

    def tracebacks(self, record: dict[str, Any]) -> dict[str, str]:
        """Seed -> the lines of the method's own code that led to the failure of that episode."""
        environment, method = record["environment"]["name"], record["method"]
        failed = [episode["seed"] for episode in record["episodes"] if episode["status"] != "ok"]
        kept = {seed: _read(self._path(environment, method, seed)) for seed in failed}
        return {seed: str(result.get("traceback", "")) if result else ""
                for seed, result in kept.items()}

    def fields(self, result: dict[str, Any]) -> dict[str, np.ndarray]:
        """The estimates that belong to a result: ``mean`` and perhaps ``std``, (T, n) in mol/m³.

        ``std`` is NaN in states of which the method claims none. ``FileNotFoundError`` if there are
        no estimates; ``ValueError``, naming the file, if it is damaged.
        """
        path = self._path(result["environment"]["name"], result["method"], result["seed"])
        path = path.with_suffix(".npz")
        try:
            with np.load(path, allow_pickle=False) as stored:
                fields = dict(stored)
        except FileNotFoundError:
            raise
        # a damaged archive may raise anything: zlib.error, NotImplementedError, RuntimeError, …
        except Exception as error:
            raise ValueError(f"estimates {path} cannot be read: {error}") from None
        # no std before a method's first claim: NaN is allowed there
        if "mean" not in fields or not all(
                each.ndim == 2 and each.dtype.kind == "f" and not np.isinf(each).any()
                for each in fields.values()) or np.isnan(fields["mean"]).any():
            raise ValueError(f"estimates {path} must hold finite numbers (T, n) named mean")
        return fields

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
            version = _latest(fresh or others[key])["version"]
            known = [each for each in others.get(key, []) if each["version"] == version]
            records.append(_gathered([*fresh, *known]))
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

    def _path(self, environment: str, method: str, seed: str) -> Path:
        name = f"{seed.replace(':', '-')}.json"
        return self.folder / "episodes" / environment.replace("/", "-") / method / name


_Groups = dict[tuple[str, str, str], list[dict[str, Any]]]


def _by_record(results: Iterable[dict[str, Any]]) -> _Groups:
    """Results that may stand in one record: of an environment, a method and a split."""
    groups: _Groups = {}
    for result in results:
        key = (result["environment"]["name"], result["method"], split_of(result["seed"]))
        groups.setdefault(key, []).append(result)
    return groups


def _latest(results: list[dict[str, Any]]) -> dict[str, Any]:
    return max(results, key=lambda result: result["finished"])


def _of_one_code(results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Those of the library and the method's file that ran last."""
    def code(result: dict[str, Any]) -> tuple[str, str]:
        return result["run"]["source"], result["method_sha256"]

    latest = code(_latest(results)) if results else None
    return [result for result in results if code(result) == latest]


def _gathered(results: list[dict[str, Any]]) -> dict[str, Any]:
    """The self-reported record of one version's episodes; of a seed's results the first success."""
    latest = _latest(results)
    chosen: dict[str, dict[str, Any]] = {}
    for result in results:
        if chosen.setdefault(result["seed"], result)["status"] != "ok":
            chosen[result["seed"]] = result
    # 9 before 10
    results = sorted(chosen.values(), key=lambda result: (len(result["seed"]), result["seed"]))
    said = [json.dumps(result["run"], sort_keys=True) for result in results]
    runs = dict(zip(said, (result["run"] for result in results), strict=True))
    place = {run: i for i, run in enumerate(runs)}
    return sealed({
        "schema": SCHEMA, "official": False, "split": split_of(latest["seed"]),
        **{key: latest[key] for key in _OF_ALL},
        "seeds": [result["seed"] for result in results], "runs": list(runs.values()),
        "episodes": [{key: value for key, value in result.items() if key not in _OF_ALL + _HERE}
                     | {"run": place[run]} for result, run in zip(results, said, strict=True)],
    })


def results_of(record: dict[str, Any]) -> list[dict[str, Any]]:
    """The results that were gathered into a record, as a store would hold them."""
    shared = {key: record[key] for key in _OF_ALL}
    return [episode | shared | {"run": record["runs"][episode["run"]]}
            for episode in record["episodes"]]


def results_in(folder: Path) -> list[dict[str, Any]]:
    """Those that were gathered into the records of a folder. Errors as `records.read_records`."""
    return [result for record in read_records(folder) for result in results_of(record)]


def _read(path: Path) -> dict[str, Any] | None:
    """A result, if it is there and whole."""
    result = read_json(path)
    return result if result is not None and _is_whole(result) else None


def _is_whole(result: dict[str, Any]) -> bool:
    """Whether a record can be gathered from it and others; the record is checked in full then."""
    if not result.keys() >= _NEEDED or not all(isinstance(result[name], str) for name in _TEXTS):
        return False
    environment = result["environment"]
    run = result["run"]
    return (isinstance(environment, dict) and isinstance(environment.get("kwargs"), dict)
            and all(isinstance(environment.get(name), str) for name in ("id", "name"))
            and isinstance(run, dict) and isinstance(run.get("source"), str)
            and (result["status"] != "ok" or _is_scored(result)))


def _is_scored(result: dict[str, Any]) -> bool:
    scores = result.get("scores")
    steps = result.get("step_errors")
    return (isinstance(scores, dict) and isinstance(scores.get("error"), int | float)
            and all(isinstance(score, int | float | None) for score in scores.values())
            and isinstance(steps, list) and all(isinstance(step, int | float) for step in steps))


def read_json(path: Path) -> dict[str, Any] | None:
    """What a file says, if it can be read and says a dict."""
    try:
        content = parsed(path)
    except ValueError:
        return None
    return content if isinstance(content, dict) else None


@lru_cache(maxsize=1)
def source_digest() -> str:
    """Hash of the code that scores depend on: stored results of other code are played again, and a
    record says of each run which it was."""
    rooms = ("numerics/*", "physics/*", "worlds/*", "data/*", "estimation/**/*", "scoring",
             "envs/*", "rl/networks", "rl/agents", "bench/outcomes", "bench/playing", "bench/run",
             "bench/scores")
    return code_digest(package_files(*(f"{room}.py" for room in rooms)))


@lru_cache(maxsize=1)
def provenance() -> dict[str, Any]:
    """Versions and commit of the code that this process runs."""
    # results, not code
    status = _git("--no-optional-locks", "status", "--porcelain", "--", ".", ":!leaderboards")
    config: Any = np.show_config(mode="dicts")  # type: ignore[call-overload]
    blas = config["Build Dependencies"]["blas"]
    packages = {name: _version(name) for name in PACKAGES}
    return {
        "versions": {"python": platform.python_version(), **packages},
        "blas": f"{blas['name']} {blas['version']}",
        "commit": _git("rev-parse", "HEAD"), "dirty": None if status is None else bool(status),
        "source": source_digest(),
    }


@lru_cache(maxsize=1)
def machine() -> dict[str, Any]:
    """The machine of this process: in a cluster, another one than that of who started the run."""
    return {"processor": _processor(), "cores": os.cpu_count(), "system": platform.system(),
            "blas_threads": 1, "matmul_seconds": matmul_seconds()}


@lru_cache(maxsize=1)
def matmul_seconds() -> float:
    """Time of a 1000 × 1000 × 1000 matrix product in double precision on one thread here, in s: the
    median of three.

    In units of it, times of different machines can be compared.
    """
    a, b = np.random.default_rng(0).normal(size=(2, 1000, 1000))
    with threadpool_limits(1):
        return float(np.median(timeit.repeat(lambda: a @ b, number=1, repeat=3)))


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
        return subprocess.run(["git", *arguments], cwd=checkout, capture_output=True, text=True,
                              timeout=10, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


def _processor() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        text = ""
    named = re.search(r"^model name[^:\n]*:(.*)", text, re.MULTILINE)
    return named[1].strip() if named else platform.processor() or platform.machine()
