"""Variables of a MATLAB file, or a sentence on why not."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat
from scipy.io.matlab import MatReadError


def variables(path: Path) -> dict[str, np.ndarray]:
    """Of a .mat file up to version 7; ``ValueError`` naming the file if it is another, truncated,
    or empty."""
    if not path.is_file():
        raise ValueError(f"{path} must be a file, there is none")
    if path.open("rb").read(19) == b"MATLAB 7.3 MAT-file":
        raise ValueError(f"{path} is a MATLAB file of version 7.3; save it with `-v7`, which is "
                         "what is read here")
    try:
        found = loadmat(path)
    except (MatReadError, NotImplementedError, OSError, TypeError, ValueError, KeyError,
            IndexError) as error:
        raise ValueError(f"{path} must be a MATLAB file that is whole: {error}") from None
    return {name: value for name, value in found.items() if not name.startswith("__")}


def needed(found: dict[str, np.ndarray], path: Path, *names: str) -> list[np.ndarray]:
    """These variables; ``ValueError`` naming those that are missing, and what is there."""
    if missing := [name for name in names if name not in found]:
        raise ValueError(f"{path} must hold {', '.join(missing)}; there are "
                         f"{', '.join(found) or 'no variables'}")
    return [found[name] for name in names]


def provenance(path: Path, **more: Any) -> dict[str, Any]:
    """The file's name and sha256, and ``more``."""
    return {"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest(), **more}
