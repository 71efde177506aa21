"""Checks of fields of a world's parts."""

from __future__ import annotations

from eitbench import _check

ADDED_LATER = {"later": True}
"""Metadata of a field that cache keys omit at its default, so that earlier keys stay valid."""


def check_positive(part: object, **units: str) -> None:
    """Raise ``ValueError`` unless these fields of a part, each with its unit, are positive."""
    for name, unit in units.items():
        _check.number(name, getattr(part, name), low=0.0, open_low=True, units=unit)


def check_not_negative(part: object, **units: str) -> None:
    """Raise ``ValueError`` if one of these fields of a part, each with its unit, is negative."""
    for name, unit in units.items():
        _check.number(name, getattr(part, name), low=0.0, units=unit)


def check_ranges(part: object, *, open_low: bool = True, **units: str) -> None:
    """Raise ``ValueError`` unless these fields, each with its unit, are ranges low ≤ high of
    positive numbers; without ``open_low`` they may be 0."""
    for name, unit in units.items():
        given = getattr(part, name)
        low, high = _check.array(name, given, (2,), units=unit)
        if not 0 <= low <= high or (open_low and low == 0):
            least = ("> 0" if open_low else "≥ 0") + (f" in {unit}" if unit else "")
            raise ValueError(f"{name} must be a range low ≤ high of numbers {least}, got {given!r}")
