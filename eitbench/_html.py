"""What a notebook shows of an object: a small table."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape


def small_table(title: str, rows: Mapping[str, str]) -> str:
    """HTML with a line for each row; whatever they hold is text."""
    lines = "".join(f'<tr><th style="text-align:left">{escape(name)}</th>'
                    f'<td style="text-align:left">{escape(text)}</td></tr>'
                    for name, text in rows.items())
    return f"<table><caption>{escape(title)}</caption>{lines}</table>"
