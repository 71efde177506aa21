"""Parallel execution in processes with one BLAS thread each."""

from __future__ import annotations

import io
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import nullcontext, redirect_stderr
from functools import lru_cache
from threading import Thread
from typing import Any, TypeVar

from tqdm import tqdm

from eitbench import _check
from eitbench.worlds.registry import Entry, import_entries, runtime_entries

BACKENDS = ("loky", "ray", "dask")
"""joblib on this machine, or a cluster."""

Result = TypeVar("Result")


class WorkerLostError(RuntimeError):
    """Error of a worker process that ended before its task was finished."""


def run_parallel(function: Callable[..., Result], arguments: Sequence[tuple], n_jobs: int,
                 backend: str = "loky") -> Iterator[Result]:
    """Yield results of ``function(*each)`` in the order of completion.

    ``ray`` and ``dask`` use the cluster of $RAY_ADDRESS or $DASK_SCHEDULER_ADDRESS, by default
    ``n_jobs`` local processes, and repeat the task of a killed process. ``loky`` raises
    `WorkerLostError` then. ``ValueError`` for an unknown backend, or one that is not installed.
    """
    _check.choice("backend", backend, BACKENDS)
    n_jobs = max(1, min(n_jobs, len(arguments)))
    try:
        run = {"loky": _with_joblib, "ray": _with_ray, "dask": _with_dask}[backend]
        yield from run(function, arguments, n_jobs)
    except ModuleNotFoundError as error:
        if error.name not in ("ray", "distributed", "dask"):
            raise
        raise ValueError(f"backend {backend} needs {error.name}, which the extra cluster installs"
                         ) from None


def _with_joblib(function: Callable[..., Result], arguments: Sequence[tuple], n_jobs: int,
                 config: Any = None, lost: type[BaseException] = BrokenProcessPool,
                 ) -> Iterator[Result]:
    from joblib import Parallel, delayed
    options = {"return_as": "generator_unordered", "batch_size": 1, "pre_dispatch": n_jobs}
    try:
        with (warnings.catch_warnings(), config or nullcontext(),
              Parallel(n_jobs=n_jobs, **options) as parallel):
            # loky replaces workers whose memory has grown
            warnings.filterwarnings("ignore", "A worker stopped while some jobs were given",
                                    UserWarning, r"joblib\.externals\.loky\.")
            entries = runtime_entries()
            pid = os.getpid()
            yield from parallel(delayed(_run_with_parent_watchdog)(pid, entries, function, *each)
                                for each in arguments)
    except lost as error:
        raise _worker_lost_error(error) from error


def _with_dask(function: Callable[..., Result], arguments: Sequence[tuple], n_jobs: int,
               ) -> Iterator[Result]:
    import distributed
    from joblib import parallel_config
    address = os.environ.get("DASK_SCHEDULER_ADDRESS")
    local = {"n_workers": n_jobs, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.Client(address) if address else distributed.Client(**local) as client:
        config = parallel_config("dask", client=client)
        yield from _with_joblib(function, arguments, n_jobs, config, distributed.KilledWorker)


def _with_ray(function: Callable[..., Result], arguments: Sequence[tuple], n_jobs: int,
              ) -> Iterator[Result]:
    """Run tasks without joblib, whose ray backend returns results only when all have succeeded.

    The standard error of a task is printed with its result.
    """
    import ray
    from ray.exceptions import NodeDiedError, OutOfMemoryError, WorkerCrashedError
    local = {} if "RAY_ADDRESS" in os.environ else {"num_cpus": n_jobs, "include_dashboard": False}
    if must_shut_down := not ray.is_initialized():
        ray.init(log_to_driver=False, **local)
    try:
        entries = runtime_entries()
        remote = ray.remote(_run_capturing_stderr)
        waiting = [remote.remote(entries, function, *each) for each in arguments]
        while waiting:
            (done,), waiting = ray.wait(waiting)
            result, written = ray.get(done)
            if written:
                tqdm.write(written, file=sys.stderr, end="")
            yield result
    except (WorkerCrashedError, NodeDiedError, OutOfMemoryError) as error:
        raise _worker_lost_error(error) from error
    finally:
        if must_shut_down:
            ray.shutdown()


def _worker_lost_error(error: BaseException) -> WorkerLostError:
    return WorkerLostError(f"a worker process was lost ({type(error).__name__}), possibly killed "
                           "for lack of memory; finished results are stored, and the same command "
                           "resumes")


def _run_with_parent_watchdog(parent: int, entries: list[Entry], function: Callable[..., Result],
                              *arguments: Any) -> Result:
    """Call `_run_single_threaded` in a process that ends soon after its ``parent``."""
    if os.getppid() == parent:
        _exit_when_parent_dies(parent)
    return _run_single_threaded(entries, function, *arguments)


@lru_cache(maxsize=1)
def _exit_when_parent_dies(parent: int) -> None:
    """End this process within a second of its parent. (The signal of Linux would arrive when the
    starting thread ends.)"""
    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    Thread(target=watch, daemon=True, name="parent watchdog").start()


def _run_capturing_stderr(entries: list[Entry], function: Callable[..., Result],
                          *arguments: Any) -> tuple[Result, str]:
    """Return the result of `_run_single_threaded` and its standard error."""
    written = io.StringIO()
    with redirect_stderr(written):
        return _run_single_threaded(entries, function, *arguments), written.getvalue()


def _run_single_threaded(entries: list[Entry], function: Callable[..., Result],
                         *arguments: Any) -> Result:
    """Call a function in a worker process, after registering the entries of a script."""
    from threadpoolctl import threadpool_limits
    import_entries(entries)
    with threadpool_limits(1):
        return function(*arguments)
