"""Optional dependencies: the extra that installs a missing module."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

EXTRAS = {
    "bench": ("cloudpickle", "jinja2", "jsonschema_rs", "markdown_it", "matplotlib", "orjson",
              "pandas", "PIL", "typer", "yaml"),
    "export": ("h5py",),
    "mesh": ("meshio",),
    "minari": ("minari",),
    "rl": ("torch", "stable_baselines3", "sb3_contrib"),
}
"""Extra -> modules that environments do not need."""


def missing_extra(what: str, error: ModuleNotFoundError) -> str | None:
    """Return a sentence with the extra that installs the missing module; None without one."""
    missing = (error.name or "").partition(".")[0]
    for extra, modules in EXTRAS.items():
        if missing in modules:
            return (f"{what} needs the extra {extra}, pip install 'eitbench[{extra}]', or in a "
                    f"checkout pip install -e '.[{extra}]': {error}")
    return None


@contextmanager
def require_extra(what: str) -> Iterator[None]:
    """Add the extra that ``what`` needs to a `ModuleNotFoundError`."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (sentence := missing_extra(what, error)) is None:
            raise
        raise ModuleNotFoundError(sentence, name=error.name) from error
