"""Argument checks; errors name the argument, the accepted values and the given value."""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Iterable
from typing import Any

import numpy as np

NUMERIC_KINDS = "biufO"
"""Kinds of arrays that can hold real numbers, without complex numbers, dates and text."""
MAX_DEPTH = 20
"""Default limit of the depth of nested lists and dicts."""
MAX_LISTED = 10
"""Largest number of accepted names that a message lists."""


def number(name: str, value: object, *, low: float = -math.inf, high: float = math.inf,
           open_low: bool = False, units: str = "") -> float:
    """Return ``value`` as a finite float within [low, high] (``open_low``: within (low, high]);
    ``ValueError`` for other values, booleans, and types that `array` rejects."""
    try:
        kind = np.asarray(value).dtype.kind
        if kind == "b" or kind not in NUMERIC_KINDS:
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
    """Return ``value`` as an int within [low, high]; ``ValueError`` for other values."""
    # stable-baselines3 returns a single action as an array without axes
    if isinstance(value, np.ndarray) and value.ndim == 0 and value.dtype.kind in "iu":
        value = value.item()
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < low or (
            high is not None and value > high):
        above = "" if high is None else f" and at most {high}"
        raise ValueError(f"{name} must be an integer of at least {low}{above}, got {value!r}")
    return int(value)


def array(name: str, value: object, shape: Iterable[int | None], *, units: str = "",
          positive: bool = False, allow_nan: bool = False) -> np.ndarray:
    """Return ``value`` as a finite float64 array of this ``shape`` (``None``: any length).

    A leading ``-1`` in ``shape`` stands for any number of batch axes. With ``allow_nan``, entries
    may be NaN. ``ValueError`` for other shapes, and for arrays without real numbers: complex ones,
    text, dates, masked arrays, and objects that are not numbers or too large for a float.
    """
    wanted = list(shape)
    batched = wanted[:1] == [-1]
    core = wanted[1:] if batched else wanted
    came = type(value).__name__
    try:
        given = np.asarray(value)
        came += f" of {given.dtype}"
        if given.dtype.kind not in NUMERIC_KINDS or isinstance(value, np.ma.MaskedArray):
            raise TypeError
        if given.dtype.kind == "O" and any(isinstance(each, (str, bytes)) for each in given.flat):
            raise TypeError
        result = given.astype(np.float64, copy=False)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name} must be an array of numbers{_in(units)}, got {came}") from None
    sizes = result.shape[max(result.ndim - len(core), 0):]
    if (len(sizes) != len(core) or (result.ndim > len(core) and not batched)
            or any(want not in (None, size) for want, size in zip(core, sizes, strict=True))):
        lengths = ["..."] * batched + ["any" if want is None else str(want) for want in core]
        text = ", ".join(lengths) + "," * (len(wanted) == 1)
        raise ValueError(f"{name} must have shape ({text}), got {result.shape}")
    wrong = np.isinf(result) if allow_nan else ~np.isfinite(result)
    if wrong.any():
        raise ValueError(f"{name} must be finite{' or NaN' * allow_nan}{_in(units)}, got "
                         f"{np.count_nonzero(wrong)} entries that are not, the first at index "
                         f"{_first(wrong)}")
    if positive and not (result > 0).all():
        raise ValueError(f"{name} must be positive{_in(units)}, got {result.min():g} at index "
                         f"{_first(result <= 0)}")
    return result


def choice(name: str, value: object, known: Iterable[str]) -> None:
    """Raise ``ValueError``, which lists similar names, unless ``value`` is among ``known``."""
    names = list(known)
    if value in names:
        return
    listed = ", ".join(names)
    if len(names) > MAX_LISTED:
        similar = difflib.get_close_matches(str(value), names, n=MAX_LISTED // 2, cutoff=0.0)
        listed = f"{', '.join(similar)}, … ({len(names)} in all)"
    raise ValueError(f"{name} must be one of {listed}; got {value!r}{did_you_mean(value, names)}")


def did_you_mean(given: object, known: Iterable[str]) -> str:
    """Return ``. Did you mean …?`` with the most similar name, or the shortest that contains the
    given one, if any, to append to a message."""
    names = {name.casefold(): name for name in known}
    text = str(given).casefold()
    found = (difflib.get_close_matches(text, names, n=1)
             or sorted((name for name in names if text and text in name), key=len))
    return f". Did you mean {names[found[0]]}?" if found else ""


def depth(name: str, value: Any, deepest: int = MAX_DEPTH) -> None:
    """Raise ``ValueError`` if lists and dicts are nested more than ``deepest`` levels deep."""
    level = [value]
    for _ in range(deepest):
        level = [inner for each in level if isinstance(each, (list, tuple, dict))
                 for inner in (each.values() if isinstance(each, dict) else each)]
        if not level:
            return
    raise ValueError(f"{name} must not be nested deeper than {deepest} levels")


def json_object(name: str, value: object, size: int) -> None:
    """Raise ``ValueError`` unless ``value`` is a dict that fits in ``size`` bytes of JSON, with
    numbers that are finite as floats, nested as `depth` accepts."""
    try:
        if not isinstance(value, dict):
            raise TypeError(f"got {type(value).__name__}")
        text = json.dumps(value, allow_nan=False)
        json.loads(text, parse_int=lambda digits: math.trunc(float(digits)))
        depth(name, value)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ValueError(f"{name} must be a dict fit for JSON: {error}") from None
    if len(text) > size:
        raise ValueError(f"{name} must have at most {size} bytes as JSON, got {len(text)}")


def _first(mask: np.ndarray) -> tuple[int, ...]:
    return tuple(int(i) for i in np.argwhere(mask)[0])


def _in(units: str) -> str:
    return f" in {units}" if units else ""
