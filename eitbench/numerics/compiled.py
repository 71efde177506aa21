"""What the compiled kernels need: numba, loaded when something is computed, and working memory."""

from __future__ import annotations

import math
import os
import threading
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from eitbench._notice import say


def compiled_kernels() -> Any:
    """The module `eitbench.numerics.kernels`.

    ``RuntimeError`` if numba is missing or does not work.
    """
    _tell_of_compiling(Path(__file__).with_name("__pycache__"))
    try:
        from eitbench.numerics import kernels
    except Exception as error:
        # ImportError beside a numpy that numba does not know, RuntimeError without a cache folder
        raise RuntimeError(f"numba cannot be used ({error}); install eitbench anew, so that numba "
                           "and numpy fit together, or name a writable folder in "
                           "$NUMBA_CACHE_DIR") from error
    return kernels


@lru_cache(maxsize=1)
def _tell_of_compiling(place: Path) -> None:
    """Say so, where numba has compiled nothing yet and will keep in ``place`` what it compiles."""
    elsewhere = "NUMBA_CACHE_DIR" in os.environ or not os.access(place.parent, os.W_OK)
    if not elsewhere and not any(place.glob("kernels.*.nbi")):
        say("compiling the kernels, some 20 s, once after installation; "
            "`eitbench bank --seeds train:0` does so beforehand")


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
