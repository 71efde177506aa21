"""The door to `eitbench.numerics.kernels`: numba is loaded when something is computed."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path
from typing import Any

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
