"""The templates of our pages, in which whatever a method calls itself is text and nothing more."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import jinja2

from eitbench._foreign import cleaned
from eitbench.report.rows import badge, breakable, rows_html


def template(name: str) -> jinja2.Template:
    """One of the templates beside this file."""
    return _environment().get_template(name)


@lru_cache(maxsize=1)
def _environment() -> jinja2.Environment:
    made = jinja2.Environment(loader=jinja2.PackageLoader("eitbench.report", "."), autoescape=True,
                              trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
                              undefined=jinja2.StrictUndefined, finalize=_seen)
    made.globals |= {"rows_html": rows_html, "breakable": breakable, "badge": badge}
    return made


def _seen(value: Any) -> Any:
    """A stranger's text with all its characters to be seen; what is HTML already as it is."""
    return cleaned(value, lines=True) if type(value) is str else value
