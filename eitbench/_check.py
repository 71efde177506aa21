"""Argument checks that name the argument, what came and what was expected."""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Iterable
from typing import Any

import numpy as np

NUMBERS = "biufO"
"""Kinds of arrays that may stand for real numbers; not complex ones, dates or text."""


def number(name: str, value: object, *, low: float = -math.inf, high: float = math.inf,
           open_low: bool = False, units: str = "") -> float:
    """``value`` as a finite float within [low, high] (``open_low``: within (low, high]); else a
    ``ValueError``, as for booleans and what `array` refuses."""
    try:
        kind = np.asarray(value).dtype.kind
        if kind == "b" or kind not in NUMBERS:
            raise TypeError
        result = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name} must be a number{_in(units)}, got {value!r}") from None
    if not math.isfinite(result) or result > high or result < low or (open_low and result == low):
        bracket = "(" if open_low else "["
        raise ValueError(f"{name} must be a finite number in {bracket}{low:g}, {high:g}]"
                         f"{_in(units)}, got {value!r}")
    return result


def integer(name: str, value: object, *, low: int, high: int | None = None) -> int:
    """``value`` as an int within [low, high]; else a ``ValueError``."""
    # as stable-baselines3 gives a single action
    if isinstance(value, np.ndarray) and value.ndim == 0 and value.dtype.kind in "iu":
        value = value.item()
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < low or (
            high is not None and value > high):
        above = "" if high is None else f" and at most {high}"
        raise ValueError(f"{name} must be an integer of at least {low}{above}, got {value!r}")
    return int(value)


def array(name: str, value: object, shape: Iterable[int | None], *, units: str = "",
          positive: bool = False) -> np.ndarray:
    """``value`` as a finite float64 array whose trailing axes match ``shape`` (``None``: any
    length).

    A leading ``-1`` in ``shape`` stands for any number of batch axes. ``ValueError`` for other
    shapes, and for what holds no real numbers: complex ones, text, dates, masked arrays, and
    objects that are no numbers or too large for a float.
    """
    wanted = list(shape)
    batched = bool(wanted) and wanted[0] == -1
    core = wanted[1:] if batched else wanted
    came = type(value).__name__
    try:
        given = np.asarray(value)
        came += f" of {given.dtype}"
        if given.dtype.kind not in NUMBERS or isinstance(value, np.ma.MaskedArray):
            raise TypeError
        if given.dtype.kind == "O" and any(isinstance(each, (str, bytes)) for each in given.flat):
            raise TypeError
        result = given.astype(np.float64, copy=False)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name} must be an array of numbers{_in(units)}, got {came}") from None
    trailing = result.shape[result.ndim - len(core):] if result.ndim >= len(core) else ()
    fits = (result.ndim >= len(core) if batched else result.ndim == len(core)) and all(
        want is None or want == have for want, have in zip(core, trailing, strict=True))
    if not fits:
        lengths = ["any" if want is None else str(want) for want in core]
        text = ", ".join(["..."] * batched + lengths)
        text += "," if len(wanted) == 1 else ""
        raise ValueError(f"{name} must have shape ({text}), got {result.shape}")
    if not np.isfinite(result).all():
        wrong = ~np.isfinite(result)
        raise ValueError(f"{name} must be finite{_in(units)}, got {np.count_nonzero(wrong)} "
                         f"entries that are not, the first at index {_first(wrong)}")
    if positive and not (result > 0).all():
        raise ValueError(f"{name} must be positive{_in(units)}, got {result.min():g} at index "
                         f"{_first(result <= 0)}")
    return result


def nearest(given: object, known: Iterable[str]) -> str:
    """`` Did you mean …?``, to end a message that names what is ``known``; empty if nothing is
    near."""
    names = {name.casefold(): name for name in known}
    found = difflib.get_close_matches(str(given).casefold(), names, n=1)
    return f". Did you mean {names[found[0]]}?" if found else ""


DEEPEST = 20
"""How deep lists and dicts from elsewhere may be nested."""


def nesting(name: str, value: Any, deepest: int = DEEPEST) -> None:
    """``ValueError`` if lists and dicts are nested too deep for what goes through them."""
    level = [value]
    for _ in range(deepest):
        level = [inner for each in level if isinstance(each, (list, tuple, dict))
                 for inner in (each.values() if isinstance(each, dict) else each)]
        if not level:
            return
    raise ValueError(f"{name} must not be nested deeper than {deepest} levels")


def document(name: str, value: object, size: int) -> None:
    """``ValueError`` unless ``value`` is a dict that JSON can hold in so many bytes, its numbers
    finite, also as floats, and not nested too deep."""
    try:
        if not isinstance(value, dict):
            raise TypeError(f"got {type(value).__name__}")
        text = json.dumps(value, allow_nan=False)
        json.loads(text, parse_int=lambda digits: math.trunc(float(digits)))
        nesting(name, value)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ValueError(f"{name} must be a dict fit for JSON: {error}") from None
    if len(text) > size:
        raise ValueError(f"{name} must have at most {size} bytes as JSON, got {len(text)}")


def _first(mask: np.ndarray) -> tuple[int, ...]:
    return tuple(int(i) for i in np.argwhere(mask)[0])


def _in(units: str) -> str:
    return f" in {units}" if units else ""
