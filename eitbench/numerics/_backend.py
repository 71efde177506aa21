"""Which of the two linear-algebra backends is used: compiled kernels (numba), or scipy wherever numba is missing."""

from __future__ import annotations

import math
import threading
from importlib.metadata import version
from importlib.util import find_spec
from typing import Any, Literal

import numpy as np

Backend = Literal["auto", "compiled", "scipy"]


def use_compiled(backend: Backend) -> bool:
    """Whether to use the kernels; `ValueError` for an unknown backend or one that is not installed."""
    if backend not in ("auto", "compiled", "scipy"):
        raise ValueError(f"backend must be 'auto', 'compiled' or 'scipy', got {backend!r}")
    installed = find_spec("numba") is not None
    if backend == "compiled" and not installed:
        raise ValueError("backend 'compiled' needs numba, which is not installed: pip install 'eitbench[fast]'")
    return installed and backend != "scipy"


def backend_version() -> str:
    """What "auto" means here, for records: results agree between backends to rounding only."""
    return f"numba {version('numba')}" if use_compiled("auto") else "scipy"


def kernels() -> Any:
    """The compiled kernels; numba is loaded here, when something is factorised, and not before.

    Raises
    ------
    RuntimeError
        If numba is installed but does not work.
    """
    try:
        from eitbench.numerics import _kernels
    except Exception as error:      # ImportError beside a numpy that is too new, RuntimeError without a cache folder
        raise RuntimeError(f"numba {version('numba')} is installed but cannot be used ({error}); uninstall it to "
                           "compute with scipy, or name a writable folder in $NUMBA_CACHE_DIR") from error
    return _kernels


def aligned_zeros(shape: tuple[int, ...]) -> np.ndarray:
    """Fresh doubles that begin a cache line: vectors across two lines cost up to twice as much."""
    size = math.prod(shape)
    memory = np.zeros(size + 8)
    skip = -(memory.ctypes.data // 8) % 8
    return memory[skip:skip + size].reshape(shape)


_memory = threading.local()


def scratch(size: int) -> np.ndarray:
    """(size,) aligned doubles of this thread, good until the next call; kept, since fresh memory is slow to touch."""
    if getattr(_memory, "doubles", np.empty(0)).size < size:
        _memory.doubles = aligned_zeros((size,))
    return _memory.doubles[:size]
