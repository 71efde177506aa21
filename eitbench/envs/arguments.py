"""Keyword arguments of environments, which come from JSON, turned into scenarios and assumptions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any, TypeVar

from eitbench import _check
from eitbench.worlds.pipe2d import PROFILES

S = TypeVar("S")


def with_fields(kind: Callable[..., S], changes: dict[str, Any] | None, **arguments: Any) -> S:
    """A scenario of this class with some fields changed; lists become tuples.

    ``arguments`` are the fields that an environment takes by themselves: in ``changes`` they would be lost, or win.
    """
    changes = {} if changes is None else changes
    if not isinstance(changes, dict):
        raise ValueError(f"scenario must be a dict of fields, got {changes!r}")
    for name in arguments.keys() & changes.keys():
        raise ValueError(f"{name} must be given as an argument, not in scenario; got scenario {changes!r}")
    changes = {name: tuple(value) if isinstance(value, list) else value
               for name, value in (changes | arguments).items()}
    known = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    unknown = sorted(changes.keys() - set(known))
    if unknown:
        raise ValueError(f"scenario has no field {unknown[0]!r}; there are {', '.join(known)}")
    return kind(**changes)


def assumed_flow(mean_velocity: float | None, profile: str | None = None) -> dict[str, Any]:
    """What a model of the 2D pipe is told to believe; None: the truth, or the nominal flow where that is not known."""
    assumptions: dict[str, Any] = {}
    if mean_velocity is not None:
        assumptions["mean_velocity"] = _check.number("assumed_mean_velocity", mean_velocity, low=0.0, units="m/s")
    if profile is not None:
        if profile not in PROFILES:
            raise ValueError(f"assumed_profile must be one of {', '.join(PROFILES)}, got {profile!r}")
        assumptions["profile"] = profile
    return assumptions
