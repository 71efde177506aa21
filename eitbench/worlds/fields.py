"""Checks of the fields of a world's parts."""

from __future__ import annotations

from eitbench import _check

ADDED_LATER = {"later": True}
"""Metadata of a number that a part was given later: at its default it is left out of the names
under which things are kept, so that what was kept before it came is still found."""


def check_positive(part: object, **units: str) -> None:
    """``ValueError`` unless these numbers of a part, each with its unit, are above 0."""
    for name, unit in units.items():
        _check.number(name, getattr(part, name), low=0.0, open_low=True, units=unit)


def check_range(part: object, name: str, units: str = "", open_low: bool = True) -> None:
    """``ValueError`` unless this pair of a part's numbers is 0 < low ≤ high, or 0 ≤ low ≤ high."""
    given = getattr(part, name)
    low, high = _check.array(name, given, (2,), units=units)
    if not 0 <= low <= high or (open_low and low == 0):
        least = ("> 0" if open_low else "≥ 0") + (f" in {units}" if units else "")
        raise ValueError(f"{name} must be a range low ≤ high of numbers {least}, got {given!r}")
