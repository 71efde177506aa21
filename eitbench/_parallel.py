"""Work spread over processes, each with one BLAS thread: more of them only get into each other's way."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

Result = TypeVar("Result")


def in_parallel(function: Callable[..., Result], arguments: Sequence[tuple], n_jobs: int) -> Iterator[Result]:
    """Results of ``function(*each)``, as they come."""
    from joblib import Parallel, delayed
    n_jobs = max(1, min(n_jobs, len(arguments)))
    with Parallel(n_jobs=n_jobs, return_as="generator_unordered", batch_size=1, pre_dispatch=n_jobs) as parallel:
        yield from parallel(delayed(_pinned)(function, *each) for each in arguments)


def _pinned(function: Callable[..., Result], *arguments: Any) -> Result:
    from threadpoolctl import threadpool_limits
    with threadpool_limits(1):
        return function(*arguments)
