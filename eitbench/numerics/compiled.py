"""The door to `eitbench.numerics.kernels`: numba is loaded when something is computed."""

from __future__ import annotations

from typing import Any


def compiled_kernels() -> Any:
    """The module `eitbench.numerics.kernels`.

    ``RuntimeError`` if numba is missing or does not work.
    """
    try:
        from eitbench.numerics import kernels
    except Exception as error:
        # ImportError beside a numpy that numba does not know, RuntimeError without a cache folder
        raise RuntimeError(f"numba cannot be used ({error}); install eitbench anew, so that numba "
                           "and numpy fit together, or name a writable folder in "
                           "$NUMBA_CACHE_DIR") from error
    return kernels
