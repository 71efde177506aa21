"""Names of `eitbench.data.cache` under the module's former name, until their users are adapted."""

from dataclasses import fields, is_dataclass
from typing import Any

from eitbench.data.cache import (  # noqa: F401
    CACHE_VARIABLE,
    cache_folder,
    cache_in,
    described,
    folder,
    npy,
    world_digest,
)


def kinds(part: Any) -> list[type]:
    """Return the classes of a world's parts and their ancestors, each once."""
    inner = [kind for each in fields(part) if is_dataclass(value := getattr(part, each.name))
             for kind in kinds(value)]
    return list(dict.fromkeys([*type(part).__mro__, *inner]))
