"""The templates of our pages, in which whatever a method calls itself is text and nothing more."""

from __future__ import annotations

from functools import lru_cache
from typing import Any
from urllib.parse import quote

import jinja2

from eitbench._foreign import cleaned
from eitbench.report.rows import badge, breakable, rows_html

_DRAWING = ('<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 32 32">'
            '<rect y="5" width="32" height="22" rx="5" fill="#0b6e75"/>'
            '<path d="M4 21C12 12 18 20 28 11" stroke="#f0c246" stroke-width="5" fill="none"/>'
            '</svg>')
ICON = f"data:image/svg+xml,{quote(_DRAWING, safe='')}"
"""A pipe and what flows in it, for the browser's tab."""


def template(name: str) -> jinja2.Template:
    """One of the templates beside this file."""
    return _environment().get_template(name)


@lru_cache(maxsize=1)
def _environment() -> jinja2.Environment:
    made = jinja2.Environment(loader=jinja2.PackageLoader("eitbench.report", "."), autoescape=True,
                              trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
                              undefined=jinja2.StrictUndefined, finalize=_seen)
    made.globals |= {"rows_html": rows_html, "breakable": breakable, "badge": badge,
                     "icon": ICON}
    return made


def _seen(value: Any) -> Any:
    """A stranger's text with all its characters to be seen; what is HTML already as it is."""
    return cleaned(value, lines=True) if type(value) is str else value
