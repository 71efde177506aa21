"""Common parts of the speed benchmarks: timing, rows of tables, and the machine's peak performance.

All times are the minimum of several calls, which is reproducible on a shared machine.
"""

from __future__ import annotations

import ctypes
import gc
import math
import os
import platform
import re
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_info

Work = Callable[[], object]

ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OMP_NUM_THREADS": "1",
              "NUMBA_NUM_THREADS": "1",
              "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
              "NPROC": "1", "JAX_PLATFORMS": "cpu"}
"""Environment of every measurement; the libraries read it when they are loaded."""


# -- timing ----------------------------------------------------------------------------------------


def best_of(work: Work, repeats: int = 5) -> float:
    """Return the seconds of the fastest call."""
    return compare({"": work}, repeats)[""]


def compare(candidates: dict[str, Work], rounds: int = 7, *, warm_up: bool = True,
            turn: float = 0.02
            ) -> dict[str, float]:
    """Return the seconds of the fastest call of each candidate.

    Calls alternate between candidates, so that changes of the machine's speed affect all; a turn is
    one call, or repeated calls for ``turn`` seconds. ``warm_up=False`` skips the first call, which
    is not counted, for long calls.
    """
    if warm_up:
        for work in candidates.values():
            work()
    best = dict.fromkeys(candidates, math.inf)
    for _ in range(rounds):
        for name, work in candidates.items():
            end = time.perf_counter() + turn
            while True:
                begin = time.perf_counter()
                work()
                now = time.perf_counter()
                best[name] = min(best[name], now - begin)
                if now >= end:
                    break
    return best


def in_fresh_process(function: Callable[..., Any], *arguments: Any) -> Any:
    """Return the result of a module's function, from a new process limited to one thread."""
    os.environ.update(ONE_THREAD)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def peak_growth(work: Work) -> float:
    """Return the peak growth of this process's resident memory, in bytes, while ``work`` runs
    (Linux with glibc).

    `resource.getrusage` would include memory of the parent process.
    """
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)                 # freed memory would be reused
    Path("/proc/self/clear_refs").write_text("5")        # reset the peak
    before = _status("VmRSS")
    work()
    return _status("VmHWM") - before


def _status(name: str) -> float:
    found = re.search(rf"{name}:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found
    return 1024.0 * int(found[1])


# -- rows ------------------------------------------------------------------------------------------


@dataclass
class Row:
    """One row of a table: eitbench and a reference, measured in the same run."""

    section: str
    what: str
    """description of the measured work"""
    against: str
    """description of the reference"""
    ours: float
    """value of eitbench in ``unit``"""
    reference: float | None
    """value of the reference; None without one, or if the peer is not installed"""
    target: str = ""
    """target of the ratio, e.g. "≤ 1.6×", "≤ 1/3" or "≥ 5× faster", or of ``ours``: "≤ 0.5 s",
    "≥ 60,000/s" """
    limit: str = ""
    """limiting resource: flops, bytes, Python overhead"""
    ceiling: str = ""
    """attained value and measured ceiling, e.g. "2.1 of 38 GFlop/s" """
    unit: str = "s"
    """"s" or "B" """

    @property
    def ratio(self) -> float | None:
        """Value of eitbench divided by the reference."""
        return None if self.reference is None else self.ours / self.reference

    @property
    def ratio_text(self) -> str:
        if self.ratio is None:
            return "–"
        word = "faster" if self.unit == "s" else "less"
        if "faster" in self.target or (not self.target and self.ratio < 0.5):
            return f"{1 / self.ratio:.3g}× {word}"
        return f"{self.ratio:.2f}×" if self.ratio > 0.095 else f"{self.ratio:.2g}×"

    @property
    def met(self) -> bool | None:
        """True if the target is met; None without a target, or without the reference it
        requires."""
        if not self.target:
            return None
        parsed = re.fullmatch(r"([≤≥]) (\d[\d.,]*(?:/\d+)?)(×|× faster| s|/s|)", self.target)
        if parsed is None:
            raise ValueError("target must read like '≤ 1.6×', '≤ 1/3', '≥ 5× faster', '≤ 0.5 s' or "
                             f"'≥ 60,000/s', got {self.target!r}")
        sense, number, kind = parsed.groups()
        if kind in (" s", "/s"):
            value = self.ours if kind == " s" else 1 / self.ours
        elif self.ratio is None:
            return None
        else:
            value = 1 / self.ratio if kind == "× faster" else self.ratio
        bound = float(Fraction(number.replace(",", "")))
        return value <= bound if sense == "≤" else value >= bound

    @property
    def cells(self) -> list[str]:
        """Columns of the table after ``section``, in order."""
        verdict = {None: "", True: ", met", False: ", **missed**"}[self.met]
        reference = "–" if self.reference is None else quantity(self.reference, self.unit)
        return [self.what, self.against, quantity(self.ours, self.unit), reference, self.ratio_text,
                self.target + verdict, self.limit, self.ceiling]


COLUMNS = ["what", "against", "eitbench", "reference", "ratio", "target", "limited by", "ceiling"]


def quantity(value: float, unit: str) -> str:
    """Format with three digits and a unit prefix, e.g. "1.32 ms" and "4.5 GB"."""
    sizes = {"G": 1e9, "M": 1e6, "k": 1e3, "": 1.0, "m": 1e-3, "µ": 1e-6, "n": 1e-9}
    prefix = next((prefix for prefix, size in sizes.items()
                   if value >= 0.9995 * size and not (unit == "s" and size > 1)), "n")
    return f"{value / sizes[prefix]:.3g} {prefix}{unit}"


def peer(package: str) -> str:
    """Return "name version" for a row, or that the package is not installed."""
    try:
        return f"{package} {version(package)}"
    except PackageNotFoundError:
        return f"{package} (not installed)"


# -- the machine -----------------------------------------------------------------------------------


class Ceilings(NamedTuple):
    """Peak performance of one thread of this machine."""

    gflops: float
    """dgemm, 1000 × 1000"""
    read: float
    """GB/s, dot product of one array far larger than the caches"""
    copy: float
    """GB/s, read and written, of such an array"""
    call: float
    """seconds for an empty Python function"""


@lru_cache
def ceilings() -> Ceilings:
    """Measure the ceilings, once per process."""
    rng = np.random.default_rng(0)
    A, B = rng.random((2, 1000, 1000))
    product = np.empty_like(A)
    large = rng.random(25_000_000)
    copied = np.empty_like(large)

    def calls() -> None:
        for _ in range(100_000):
            _nothing()

    dgemm = best_of(lambda: np.matmul(A, B, out=product), 25)
    read, copy = best_of(lambda: large @ large), best_of(lambda: np.copyto(copied, large))
    return Ceilings(2e-9 * 1000**3 / dgemm, 1e-9 * large.nbytes / read, 2e-9 * large.nbytes / copy,
                    best_of(calls) / 100_000)


def _nothing() -> None:
    pass


def of_flops(flops: float, seconds: float) -> str:
    """Format attained and peak flops, for a row's ceiling."""
    return f"{1e-9 * flops / seconds:.2g} of {ceilings().gflops:.0f} GFlop/s"


def machine() -> dict[str, str]:
    """Describe machine and libraries; call it before peers load other BLAS libraries."""
    cpuinfo = Path("/proc/cpuinfo")
    model = re.search(r"model name\s*:\s*(.+)", cpuinfo.read_text()) if cpuinfo.exists() else None
    forced = " (OPENBLAS_CORETYPE)" if os.environ.get("OPENBLAS_CORETYPE") else ""
    blas = {f"{library['internal_api']} {library['version']}, {library.get('architecture', '?')} "
            f"kernels{forced}, {library['num_threads']} thread" for library in threadpool_info()
            if library["user_api"] == "blas"}
    return {"CPU": model[1] if model else platform.processor() or platform.machine(),
            "cores": str(os.cpu_count()),
            "Python": platform.python_version(), "BLAS": "; ".join(sorted(blas)),
            **{name: peer(name).split(" ", 1)[1] for name in ("numpy", "scipy", "numba")}}
