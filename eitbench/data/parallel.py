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

from eitbench.worlds.registry import Entry, import_entries, runtime_entries

BACKENDS = ("loky", "ray", "dask")
"""Joblib on this machine, or a cluster."""

Result = TypeVar("Result")


class WorkerLostError(RuntimeError):
    """A process ended before its work was done."""


def run_parallel(function: Callable[..., Result], arguments: Sequence[tuple], n_jobs: int,
                backend: str = "loky") -> Iterator[Result]:
    """Yield results of ``function(*each)`` in the order of completion.

    ``ray`` and ``dask`` use the cluster of $RAY_ADDRESS or $DASK_SCHEDULER_ADDRESS, and without one
    ``n_jobs`` processes here; another process repeats the work of a killed one. With loky that is a
    `WorkerLostError`. ``ValueError`` for an unknown backend, or one that is not installed.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}, got {backend!r}")
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
    how = {"return_as": "generator_unordered", "batch_size": 1, "pre_dispatch": n_jobs}
    # loky ends workers whose memory has grown, and starts others
    warnings.filterwarnings("ignore", "A worker stopped while some jobs were given", UserWarning,
                            r"joblib\.externals\.loky\.")
    try:
        with config or nullcontext(), Parallel(n_jobs=n_jobs, **how) as parallel:
            told = runtime_entries()
            here = os.getpid()
            yield from parallel(delayed(_run_with_parent_watchdog)(here, told, function, *each)
                                for each in arguments)
    except lost as error:
        raise _worker_lost_error(error) from error


def _with_dask(function: Callable[..., Result], arguments: Sequence[tuple], n_jobs: int,
               ) -> Iterator[Result]:
    import distributed
    from joblib import parallel_config
    where = os.environ.get("DASK_SCHEDULER_ADDRESS")
    local = {"n_workers": n_jobs, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.Client(where) if where else distributed.Client(**local) as client:
        config = parallel_config("dask", client=client)
        yield from _with_joblib(function, arguments, n_jobs, config, distributed.KilledWorker)


def _with_ray(function: Callable[..., Result], arguments: Sequence[tuple], n_jobs: int,
              ) -> Iterator[Result]:
    """Without joblib, whose backend for ray returns all results at the end or, if one fails, none.
    What a call writes to standard error comes with its result."""
    import ray
    from ray.exceptions import NodeDiedError, OutOfMemoryError, WorkerCrashedError
    here = {} if "RAY_ADDRESS" in os.environ else {"num_cpus": n_jobs, "include_dashboard": False}
    if ours := not ray.is_initialized():
        ray.init(log_to_driver=False, **here)
    try:
        told = runtime_entries()
        remote = ray.remote(_run_capturing_stderr)
        waiting = [remote.remote(told, function, *each) for each in arguments]
        while waiting:
            (done,), waiting = ray.wait(waiting)
            result, written = ray.get(done)
            if written:
                tqdm.write(written, file=sys.stderr, end="")
            yield result
    except (WorkerCrashedError, NodeDiedError, OutOfMemoryError) as error:
        raise _worker_lost_error(error) from error
    finally:
        if ours:
            ray.shutdown()


def _worker_lost_error(error: BaseException) -> WorkerLostError:
    return WorkerLostError("a process was lost, killed perhaps for want of memory "
                      f"({type(error).__name__}); what was finished is kept, and the same command "
                      "goes on from there")


def _run_with_parent_watchdog(host: int, told: list[Entry], function: Callable[..., Result],
                              *arguments: Any) -> Result:
    """Call `_run_single_threaded` in a process that ends soon after ``host``, its parent."""
    if os.getppid() == host:
        _exit_when_parent_dies(host)
    return _run_single_threaded(told, function, *arguments)


@lru_cache(maxsize=1)
def _exit_when_parent_dies(host: int) -> None:
    """End this process within a second of its parent. (Linux's own signal would come as soon as the
    thread ends that has started it.)"""
    def look() -> None:
        while os.getppid() == host:
            time.sleep(1.0)
        os._exit(1)

    Thread(target=look, daemon=True, name="end with the host").start()


def _run_capturing_stderr(told: list[Entry], function: Callable[..., Result], *arguments: Any,
           ) -> tuple[Result, str]:
    """Return the result of `_run_single_threaded`, and what was written to standard error."""
    written = io.StringIO()
    with redirect_stderr(written):
        return _run_single_threaded(told, function, *arguments), written.getvalue()


def _run_single_threaded(told: list[Entry], function: Callable[..., Result],
                         *arguments: Any) -> Result:
    """Call a function in another process, which takes over the worlds that a script registered."""
    from threadpoolctl import threadpool_limits
    import_entries(told)
    with threadpool_limits(1):
        return function(*arguments)
