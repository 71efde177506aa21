"""Names and titles that strangers choose: they can be read, fit everywhere, and pose as none of
ours."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterator
from functools import lru_cache

from eitbench._foreign import cleaned
from eitbench.bench.methods import own_files

LONGEST = 100
"""letters of a method's name, which becomes that of a file"""
_SEEN = "LNPS"
"""First letters of the categories of characters that leave ink."""
_BLANK = "\u2800\u3164\u115f\u1160\uffa0"
"""These are said to, and do not."""
_MARKS = {"Mn", "Me"}
"""Categories of marks on the letter before."""
_HIGH = "^" * 5
"""So many on one tower over the lines above."""
_LIKE = str.maketrans("аеорсухіјѕԁһӏԛԝвмнткгпьαεορτυνικηγωβ01|ıɑɡ",
                      "aeopcyxijsdhlqwbmhtkrnbaeoptuvikhywbolliag")
"""Letters of other alphabets and digits -> what they look like."""


def faults(method: str, title: str, environment: str) -> Iterator[str]:
    """What is wrong with how a method calls itself in an environment: a sentence for each, which
    begins with the field."""
    for field, text in (("method", method), ("title", title)):
        if cleaned(text) != text:
            yield f"$.{field}: must have no control characters, and none that turn the text round"
        elif not _is_seen(text):
            yield (f"$.{field}: must have letters that can be seen, four marks on one at most, and "
                   "no space around them")
    if len(method) > LONGEST:
        yield f"$.method: must have {LONGEST} letters at most"
    ours = own_files(environment)
    like = _likenesses(frozenset(ours)).get(likeness(method), method)
    if like != method and method not in ours:
        yield f"$.method: must not look like one of ours, {like}"


def folded(name: str) -> str:
    """What two names have in common that are one file, or one page, on some systems."""
    return unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", name).casefold())


def likeness(name: str) -> str:
    """What two names have in common that readers take for one: letters and digits by their
    looks."""
    plain = unicodedata.normalize("NFKD", folded(name)).translate(_LIKE)
    letters = "".join(each for each in plain if each.isalnum())
    return letters.replace("rn", "m").replace("vv", "w")


def _is_seen(text: str) -> bool:
    kinds = [unicodedata.category(each) for each in text]
    towers = _HIGH in "".join("^" if kind in _MARKS else " " for kind in kinds)
    inked = any(kind[0] in _SEEN and each not in _BLANK
                for kind, each in zip(kinds, text, strict=True))
    return inked and not towers and text.strip() == text


@lru_cache(maxsize=64)
def _likenesses(names: frozenset[str]) -> dict[str, str]:
    """Likeness -> name."""
    return {likeness(name): name for name in sorted(names)}
