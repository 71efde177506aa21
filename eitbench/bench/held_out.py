"""Compare a record with held-out episodes, whose seeds are derived from the maintainers' secret.

Held-out episode k = 0, 1, … has the seed SHA-256(secret ‖ k) mod 2⁶³, with k as eight bytes, most
significant first. The SHA-256 of the secret is committed to ``leaderboards/held_out.json``, so that
the secret cannot be chosen after a method is known.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import permutation_test

from eitbench._files import bundled_path
from eitbench.bench.isolation import WorkerError, check_out_of_reach, close
from eitbench.bench.methods import is_builtin
from eitbench.bench.records import read_record
from eitbench.bench.run import Job, run_episode
from eitbench.bench.text import scores_by_seed
from eitbench.bench.tracks import NAIVE_BASELINES
from eitbench.bench.verify import job_for_record
from eitbench.data.cache import use_cache_dir
from eitbench.data.seeds import SPLITS, parse_seeds

COMMITMENT = bundled_path("leaderboards") / "held_out.json"
SECRET_BYTES = 32
SIGNIFICANCE_LEVEL = 0.05
MIN_RATIO = 1e-12
FIRST_SEED = max(split.stop for split in SPLITS.values())
"""Seeds below belong to the public splits."""


def read_secret(path: Path) -> bytes:
    """Read the secret, hexadecimal digits in a private file. ``ValueError`` if it cannot be read,
    other users or isolated methods can read it, or it does not match the commitment."""
    check_out_of_reach(path, "secret")
    try:
        is_shared = os.name == "posix" and path.stat().st_mode & 0o077
        secret = bytes.fromhex(path.read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"secret {path} must be a file of hexadecimal digits: {error}") from None
    if is_shared:
        raise ValueError(f"secret {path} must be readable by its owner only; use `chmod 600`")
    if len(secret) != SECRET_BYTES:
        raise ValueError(f"secret {path} must have {SECRET_BYTES} bytes, got {len(secret)}")
    digest = hashlib.sha256(secret).hexdigest()
    committed = json.loads(COMMITMENT.read_text())["salt_sha256"] if COMMITMENT.exists() else None
    if committed != digest:
        raise ValueError(f"secret {path} has the sha256 {digest}, but {COMMITMENT} commits to "
                         f"{committed}")
    return secret


def held_out_seeds(secret: bytes, count: int) -> list[int]:
    """Return the seeds of the first ``count`` held-out episodes."""
    digests = (hashlib.sha256(secret + k.to_bytes(8, "big")).digest() for k in range(count))
    drawn = (int.from_bytes(digest, "big") % 2**63 for digest in digests)
    return [seed if seed >= FIRST_SEED else seed + FIRST_SEED for seed in drawn]


def verify_all_held_out(paths: Sequence[Path], folder: Path, file: str | None, isolate: str,
                        secret: bytes, episodes: int) -> tuple[list[dict[str, str]], list[str]]:
    """Verify records one after the other by `verify_held_out`, with ``file`` and ``isolate`` of
    `job_for_record` and a cache in ``folder``; return the rows, and the problems by record."""
    rows: list[dict[str, str]] = []
    problems: list[str] = []
    with use_cache_dir(folder / "held-out"):
        for path in paths:
            try:
                record = read_record(path)
                job = job_for_record(record, file, isolate, path)
                row, found = verify_held_out(record, job, secret, episodes)
            except (ValueError, WorkerError) as error:
                row, found = {}, [str(error)]
            rows += [{"error relative to the naive baseline": path.stem} | row] if row else []
            problems += [f"{path.name}: {sentence}" for sentence in found]
        close()
    return rows, problems


def verify_held_out(record: dict[str, Any], job: Job, secret: bytes,
                    episodes: int) -> tuple[dict[str, str], list[str]]:
    """Run a record's method, by the ``job`` of `verify.job_for_record`, on held-out episodes, and
    test whether the recorded errors are smaller. Errors are relative to the naive baseline's, which
    is run here too, on the same episodes.

    Returns a row with the geometric means of the relative errors, recorded and held-out, and p; and
    a sentence for each problem. ``ValueError`` if the episodes are too few for the test, or a
    third-party method is not confined by bubblewrap and could read the seeds.
    """
    if not is_builtin(job.method) and job.isolation != "bubblewrap":
        raise ValueError(f"{job.method} must run under bubblewrap on held-out episodes, got "
                         f"isolation {job.isolation}")
    public = scores_by_seed(record, "error")
    if math.comb(episodes + len(public), episodes) < 2.0 / SIGNIFICANCE_LEVEL:
        raise ValueError("held-out and recorded episodes must be more for a test, got "
                         f"{episodes} and {len(public)}")
    baseline = Job(job.environment, NAIVE_BASELINES[job.environment.track], 0)
    seeds = held_out_seeds(secret, episodes)
    own, naive = (_errors(each, seeds) for each in (job, baseline))
    there = _errors(baseline, [parse_seeds(name)[0] for name in public])
    problems = [f"held-out episode {k}: {error}" for k, error in enumerate(own)
                if isinstance(error, str)]
    recorded = _log_ratios(list(public.values()), there)
    held_out = _log_ratios(own, naive)
    if min(len(recorded), len(held_out)) < 2:
        return {}, problems
    p = p_value(recorded, held_out)
    means = [float(np.exp(each.mean())) for each in (recorded, held_out)]
    row = {"recorded": f"{means[0]:.3g} ({len(recorded)})",
           "held-out": f"{means[1]:.3g} ({len(held_out)})", "p": f"{p:.2g}"}
    if p < SIGNIFICANCE_LEVEL:
        problems.append(f"error relative to {baseline.method}: {means[0]:.3g} in the record, "
                        f"{means[1]:.3g} on held-out episodes (p = {p:.2g})")
    return row, problems


def p_value(recorded: np.ndarray, held_out: np.ndarray, n_resamples: int = 9999) -> float:
    """Return the p-value of a one-sided permutation test: the fraction of random divisions in which
    mean(recorded) − mean(held-out) is at most the actual difference."""
    return float(permutation_test(
        (recorded, held_out), lambda a, b, axis: a.mean(axis=axis) - b.mean(axis=axis),
        vectorized=True, alternative="less", n_resamples=n_resamples,
        random_state=np.random.default_rng(0)).pvalue)


def _errors(job: Job, seeds: list[int]) -> list[Any]:
    """Return the error of each episode, or the message of a failed episode."""
    results = (run_episode(job._replace(seed=seed))[0] for seed in seeds)
    return [result["scores"]["error"] if result["status"] == "ok" else result["message"]
            for result in results]


def _log_ratios(errors: list[Any], naive: list[Any]) -> np.ndarray:
    """Return log(error / naive error) of the episodes that both finished, rounded to digits that do
    not depend on the processor."""
    ratios = [a / b for a, b in zip(errors, naive, strict=True)
              if not isinstance(a, str) and not isinstance(b, str) and b > 0.0]
    return np.round(np.log(np.maximum(ratios, MIN_RATIO)), 6)
