"""Variants of a world from settings such as ``instrument.noise_relative=0.01,0.02``."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable
from typing import Any


def variants(settings: Iterable[str]) -> list[dict[str, Any]]:
    """Return the argument ``world`` of `gymnasium.make` for each combination of the values.

    Settings are ``part.number=value``, or several values separated by commas; values are JSON or
    words. ``ValueError`` for malformed settings, repeated values, or two settings of one number.
    """
    chosen: dict[str, list[Any]] = {}
    for setting in settings:
        path, sign, text = setting.partition("=")
        if not sign or not text or not all(path.split(".")):
            raise ValueError("set must look like 'instrument.noise_relative=0.02' or "
                             f"'instrument.noise_relative=0.01,0.02', got {setting!r}")
        if any(path == other or path.startswith(f"{other}.") or other.startswith(f"{path}.")
               for other in chosen):
            raise ValueError(f"set must name each number once, got {path!r} again")
        values = _values(text)
        if "" in values or len({format_setting(value) for value in values}) < len(values):
            raise ValueError(f"set must give different values, none of them empty, got {setting!r}")
        chosen[path] = values
    return [_nested(zip(chosen, values, strict=True))
            for values in itertools.product(*chosen.values())]


def flatten(changes: dict[str, Any]) -> dict[str, Any]:
    """``{"instrument": {"noise_relative": 0.02}}`` -> ``{"instrument.noise_relative": 0.02}``."""
    found: dict[str, Any] = {}
    for key, value in changes.items():
        if isinstance(value, dict):
            found |= {f"{key}.{inner}": each for inner, each in flatten(value).items()}
        else:
            found[key] = value
    return found


def format_setting(value: Any) -> str:
    """Format a value as in a setting: words without quotation marks."""
    return value if isinstance(value, str) else json.dumps(value)


def _values(text: str) -> list[Any]:
    """Parse ``0.01,0.02`` as two numbers, ``[1, 2]`` as one list, ``a,b`` as two words."""
    try:
        return list(json.loads(f"[{text}]")) or [""]
    except ValueError:
        words = text.split(",")
        return words if len(words) == 1 else [each for word in words for each in _values(word)]


def _nested(settings: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Invert `flatten`."""
    made: dict[str, Any] = {}
    for path, value in settings:
        *parts, name = path.split(".")
        part = made
        for each in parts:
            part = part.setdefault(each, {})
        part[name] = value
    return made
