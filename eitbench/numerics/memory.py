"""Working memory for the compiled kernels."""

from __future__ import annotations

import math
import threading

import numpy as np


def aligned_zeros(shape: tuple[int, ...]) -> np.ndarray:
    """Fresh doubles that begin a cache line: vectors across two lines cost up to twice as much."""
    size = math.prod(shape)
    memory = np.zeros(size + 8)
    skip = -(memory.ctypes.data // 8) % 8
    return memory[skip:skip + size].reshape(shape)


_memory = threading.local()


def scratch(size: int) -> np.ndarray:
    """(size,) aligned doubles of this thread, good until the next call.

    They are kept, since fresh memory is slow to touch.
    """
    if getattr(_memory, "doubles", np.empty(0)).size < size:
        _memory.doubles = aligned_zeros((size,))
    return _memory.doubles[:size]
