"""The frame of the speed benchmarks: timing, rows of the tables, and what this machine can do at
best.

All times are the fastest of several calls: on a machine that others use too, the minimum is what
repeats.
"""

from __future__ import annotations

import ctypes
import gc
import math
import os
import platform
import re
import sys
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

sys.path.append(str(Path(__file__).parents[1] / "tests"))      # `references` is there

Work = Callable[[], object]

ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OMP_NUM_THREADS": "1",
              "NUMBA_NUM_THREADS": "1",
              "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
              "NPROC": "1", "JAX_PLATFORMS": "cpu"}
"""Environment of every measurement; the libraries read it when they are loaded."""


# -- timing ----------------------------------------------------------------------------------------


def best_of(work: Work, repeats: int = 5) -> float:
    """Seconds of the fastest call."""
    return compare({"": work}, repeats)[""]


def compare(candidates: dict[str, Work], rounds: int = 7, *, warm_up: bool = True,
            turn: float = 0.02
            ) -> dict[str, float]:
    """Seconds of the fastest call of each candidate.

    They take turns, so that a machine that changes its pace does so for all; a turn is one call, or
    as many as fit into ``turn`` seconds. ``warm_up=False`` saves the first call, which is not
    counted, where a call takes very long.
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
    """The result of a module's function, from a new process limited to one thread."""
    os.environ.update(ONE_THREAD)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def peak_growth(work: Work) -> float:
    """Bytes by which the resident memory of this process rises at most while ``work`` runs (Linux
    with glibc).

    `resource.getrusage` would count what the process that started this one had in memory.
    """
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)                 # what was freed before must not be used unseen
    Path("/proc/self/clear_refs").write_text("5")        # the peak starts anew from here
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
    """One line of a table: ours against a reference, measured in the same run."""

    section: str
    what: str
    """ours, in words"""
    against: str
    """the reference, in words"""
    ours: float
    """seconds, or what ``unit`` says"""
    reference: float | None
    """None: there is none, or the peer is not installed"""
    target: str = ""
    """of the ratio, such as "≤ 1.6×", "≤ 1/3" or "≥ 5× faster", or of ours: "≤ 0.5 s", "≥ 60,000/s"
    """
    limit: str = ""
    """what limits us: flops, bytes, Python overhead"""
    ceiling: str = ""
    """the measured ceiling beside it, such as "2.1 of 38 GFlop/s" """
    unit: str = "s"
    """"s" or "B" """

    @property
    def ratio(self) -> float | None:
        """Ours in parts of the reference."""
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
        """Whether the target was met; None without one, or without the reference that it speaks
        of."""
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
        """The table's columns after ``section``, in order."""
        verdict = {None: "", True: ", met", False: ", **missed**"}[self.met]
        reference = "–" if self.reference is None else quantity(self.reference, self.unit)
        return [self.what, self.against, quantity(self.ours, self.unit), reference, self.ratio_text,
                self.target + verdict, self.limit, self.ceiling]


COLUMNS = ["what", "against", "ours", "reference", "ratio", "target", "limited by", "ceiling"]


def quantity(value: float, unit: str) -> str:
    """Three digits and a unit prefix: "1.32 ms", "4.5 GB"."""
    sizes = {"G": 1e9, "M": 1e6, "k": 1e3, "": 1.0, "m": 1e-3, "µ": 1e-6, "n": 1e-9}
    prefix = next((prefix for prefix, size in sizes.items()
                   if value >= 0.9995 * size and not (unit == "s" and size > 1)), "n")
    return f"{value / sizes[prefix]:.3g} {prefix}{unit}"


def peer(package: str) -> str:
    """ "name version", or what is missing, for a row."""
    try:
        return f"{package} {version(package)}"
    except PackageNotFoundError:
        return f"{package} (not installed)"


# -- the machine -----------------------------------------------------------------------------------


class Ceilings(NamedTuple):
    """What one thread of this machine reaches when nothing is in the way."""

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
    """Measured once in each process that asks."""
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
    """Flops reached and reachable, for a row's ceiling."""
    return f"{1e-9 * flops / seconds:.2g} of {ceilings().gflops:.0f} GFlop/s"


def machine() -> dict[str, str]:
    """What the numbers depend on; to be asked before peers load BLAS libraries of their own."""
    cpuinfo = Path("/proc/cpuinfo")
    model = re.search(r"model name\s*:\s*(.+)", cpuinfo.read_text()) if cpuinfo.exists() else None
    forced = " as OPENBLAS_CORETYPE says" if os.environ.get("OPENBLAS_CORETYPE") else ""
    blas = {f"{library['internal_api']} {library['version']}, {library.get('architecture', '?')} "
            f"kernels{forced}, {library['num_threads']} thread" for library in threadpool_info()
            if library["user_api"] == "blas"}
    return {"CPU": model[1] if model else platform.processor() or platform.machine(),
            "cores": str(os.cpu_count()),
            "Python": platform.python_version(), "BLAS": "; ".join(sorted(blas)),
            **{name: peer(name).split(" ", 1)[1] for name in ("numpy", "scipy", "numba")}}
