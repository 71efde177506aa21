"""Results on disk: one file an episode, replaced atomically; records are gathered from them."""

from __future__ import annotations

import hashlib
import io
import json
import os
import platform
import subprocess
from collections.abc import Iterator
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from eitbench._files import write_atomically
from eitbench.seeds import name_seed

SCHEMA = 1
_NEEDED = {"identity", "seed", "baseline", "environment", "source", "baseline_sha256", "finished", "status",
           "run"}


class EpisodeStore:
    """The folder of a run: ``episodes/ENV/BASELINE/SEED.json`` with its estimates in ``SEED.npz`` beside it.

    Every file is written whole or not at all, so runs may share a folder and may be interrupted anywhere.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder).absolute()           # worker processes may stand elsewhere

    def put(self, environment: str, baseline: str, seed: int, result: dict[str, Any],
            fields: dict[str, np.ndarray]) -> None:
        """Store one episode; the estimates first, so that a result never stands without them."""
        path = self._path(environment, baseline, seed)
        if fields:
            content = io.BytesIO()
            np.savez_compressed(content, **fields)  # type: ignore[arg-type]
            write_atomically(path.with_suffix(".npz"), content.getvalue())
        write_atomically(path, json.dumps(result, indent=1, allow_nan=False).encode())

    def holds(self, environment: str, baseline: str, seed: int, identity: str) -> bool:
        """Whether a successful result of exactly this identity is there."""
        result = _read(self._path(environment, baseline, seed))
        return result is not None and result["identity"] == identity and result["status"] == "ok"

    def results(self) -> Iterator[dict[str, Any]]:
        """All stored results; files that cannot be read are passed over."""
        paths = self.folder.glob("episodes/*/*/*.json")
        for path in sorted(paths, key=lambda path: (path.parent, len(path.name), path.name)):   # 9 before 10
            result = _read(path)
            if result is not None:
                yield result

    def fields(self, result: dict[str, Any]) -> dict[str, np.ndarray]:
        """The estimates that belong to a result: ``mean`` and perhaps ``std``, (T, n) in mol/m³."""
        folder = self.folder / "episodes" / _environment_folder(result) / result["baseline"]
        with np.load(folder / f"{result['seed'].replace(':', '-')}.npz", allow_pickle=False) as stored:
            return dict(stored)

    def write_records(self) -> list[dict[str, Any]]:
        """Gather the episodes into one record per environment, baseline and split of the seeds, in ``records/``."""
        gathered: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
        for result in self.results():
            key = (json.dumps(result["environment"], sort_keys=True), result["baseline"], _split(result["seed"]))
            gathered.setdefault(key, []).append(result)
        records = []
        for (environment, baseline, split), results in gathered.items():
            # Episodes of different code never stand in one record: those of the latest run's code do.
            latest = max(results, key=lambda result: result["finished"])
            results = [r for r in results if all(r[key] == latest[key] for key in ("source", "baseline_sha256"))]
            shared = ("board", "title", "parameters", "baseline_sha256", "source")
            runs: list[dict[str, Any]] = []
            for result in results:
                if result["run"] not in runs:
                    runs.append(result["run"])
            record = {
                "schema": SCHEMA, "environment": json.loads(environment), "baseline": baseline, "split": split,
                **{key: latest[key] for key in shared}, "seeds": [result["seed"] for result in results], "runs": runs,
                "episodes": [{key: value for key, value in result.items()
                              if key not in (*shared, "environment", "baseline", "run")}
                             | {"run": runs.index(result["run"])} for result in results],
            }
            path = self.folder / "records" / f"{_environment_folder(record)}--{baseline}--{split}.json"
            write_atomically(path, json.dumps(record, indent=1, allow_nan=False).encode())
            records.append(record)
        return records

    def _path(self, environment: str, baseline: str, seed: int) -> Path:
        name = f"{name_seed(seed).replace(':', '-')}.json"
        return self.folder / "episodes" / _folder_name(environment) / _folder_name(baseline) / name


def _read(path: Path) -> dict[str, Any] | None:
    result = _read_json(path)
    return result if result is not None and result.keys() >= _NEEDED else None


def _read_json(path: Path) -> dict[str, Any] | None:
    try:
        result = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return result if isinstance(result, dict) else None


def _split(seed: str) -> str:
    return seed.split(":")[0] if ":" in seed else "own"


def _environment_folder(result: dict[str, Any]) -> str:
    return _folder_name(result["environment"].get("name", result["environment"]["id"]))


def _folder_name(text: str) -> str:
    return Path(text).stem if text.endswith(".py") else text.replace("/", "-")


@lru_cache(maxsize=1)
def source_digest() -> str:
    """Hash of the source that scores depend on: results of other code are not taken for this one's."""
    folder = Path(__file__).parent.parent
    rooms = ("physics/*", "scenarios/*", "episodes", "recordings", "regions", "task", "estimation/*", "scoring",
             "envs/*", "leaderboard/run", "leaderboard/score")
    files = sorted(path for room in rooms for path in folder.glob(f"{room}.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


@lru_cache(maxsize=1)
def provenance() -> dict[str, Any]:
    """Versions, commit and machine of this process."""
    status = _git("--no-optional-locks", "status", "--porcelain")
    return {
        "versions": {"python": platform.python_version(), **{
            name: _version(name) for name in ("eitbench", "numpy", "scipy", "gymnasium", "scikit-fem")}},
        "blas": np.show_config(mode="dicts")["Build Dependencies"]["blas"]["name"],  # type: ignore[index,call-overload]
        "commit": _git("rev-parse", "HEAD"), "dirty": None if status is None else bool(status),
        "machine": {"processor": _processor(), "cores": os.cpu_count(), "system": platform.system(),
                    "blas_threads": 1},
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _git(*arguments: str) -> str | None:
    checkout = Path(__file__).parents[2]
    if not (checkout / ".git").exists():                 # installed: a repository around it is somebody else's
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
