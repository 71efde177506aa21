"""Access to the compiled kernels, which need numba, and their working memory."""

from __future__ import annotations

import math
import os
import threading
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from eitbench._notice import notify


def compiled_kernels() -> Any:
    """Import `eitbench.numerics.kernels`; ``RuntimeError`` if numba is missing or fails."""
    _announce_compilation()
    try:
        from eitbench.numerics import kernels
    except Exception as error:
        # ImportError with an unsupported numpy, RuntimeError without a cache folder
        raise RuntimeError(f"numba cannot be used ({error}); reinstall eitbench with compatible "
                           "versions of numba and numpy, or set $NUMBA_CACHE_DIR to a writable "
                           "folder") from error
    return kernels


@lru_cache(maxsize=1)
def _announce_compilation() -> None:
    """Print a message before the first compilation, whose result numba stores in `__pycache__`."""
    folder = Path(__file__).with_name("__pycache__")
    is_elsewhere = "NUMBA_CACHE_DIR" in os.environ or not os.access(folder.parent, os.W_OK)
    if not is_elsewhere and not any(folder.glob("kernels.*.nbi")):
        notify("compiling the kernels, some 20 s, once after installation; "
            "`eitbench bank --seeds train:0` does so in advance")


def aligned_zeros(shape: tuple[int, ...]) -> np.ndarray:
    """Return an array at a cache-line boundary: vectors across two lines are up to twice slower."""
    size = math.prod(shape)
    memory = np.zeros(size + 8)
    skip = -(memory.ctypes.data // 8) % 8
    return memory[skip:skip + size].reshape(shape)


_memory = threading.local()


def scratch(size: int) -> np.ndarray:
    """Return (size,) aligned doubles of this thread, valid until the next call.

    They are reused, because first access to new memory is slow.
    """
    if getattr(_memory, "doubles", np.empty(0)).size < size:
        _memory.doubles = aligned_zeros((size,))
    return _memory.doubles[:size]
