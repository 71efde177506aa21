"""What is installed with which extra, and what is said where one is missing."""

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
"""Extra -> modules that playing from Python does not need."""


def explained(what: str, error: ModuleNotFoundError) -> str | None:
    """Which extra brings what is missing, and how; None for a module of none."""
    missing = (error.name or "").partition(".")[0]
    for extra, modules in EXTRAS.items():
        if missing in modules:
            return (f"{what} needs the extra {extra}, pip install 'eitbench[{extra}]', or in a "
                    f"checkout pip install -e '.[{extra}]': {error}")
    return None


@contextmanager
def needed_by(what: str) -> Iterator[None]:
    """A `ModuleNotFoundError` from within says which extra to install for ``what``."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (sentence := explained(what, error)) is None:
            raise
        raise ModuleNotFoundError(sentence, name=error.name) from error
