"""Lines of a table as HTML. A board may have thousands: a template would take minutes for them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import groupby

from markupsafe import Markup, escape

from eitbench._foreign import cleaned
from eitbench.bench.table import Cell, Row, Table


def rows_html(table: Table, rows: Iterable[Row] | None = None) -> Markup:
    """Lines of a table, all or only some of its ``rows``: a group of them, or a line with its
    parts, is a body of the table, which ends with the end of a line of text."""
    kinds = [kind or ("key" if heading == "ẽ_c" else "")
             for kind, heading in zip(table.kinds, table.headings, strict=True)]
    bodies = []
    for group, lines in groupby(table.rows if rows is None else rows, key=lambda row: row.group):
        said = [_line(row, kinds) for row in lines]
        if group:
            head = f'<tr><th scope="rowgroup" colspan="{len(kinds)}">{_said(group)}</th></tr>'
            said = [head + "".join(said)]
        bodies += [f"<tbody>{each}</tbody>\n" for each in said]
    return Markup("".join(bodies))


def _line(row: Row, kinds: list[str], of: str = "") -> str:
    """A line ``of`` this class, and its parts; ``kinds`` are the classes of its cells, empty for
    none."""
    flags = f' data-flags="{_said(row.flags)}"' if row.flags else ""
    cells = "".join(map(_cell, row.cells, kinds))
    parts = "".join(_line(part, kinds, ' class="part"') for part in row.parts)
    return f"<tr{of}{flags}>{cells}</tr>{parts}"


def breakable(text: str) -> str:
    """A long name may break after its underscores and its slash and before its version, but ẽ_c may
    not."""
    said = str(escape(text))
    if "_" in said or "@" in said:  # of the many numbers none has to be looked at further
        said = said.replace("_", "_<wbr/>").replace("ẽ_<wbr/>", "ẽ_").replace("@", "<wbr/>@")
    return re.sub(r"/(?=\w{3})", "/<wbr/>", said) if "/" in said else said


def _cell(cell: Cell, kind: str) -> str:
    value = "" if cell.value is None else f' data-value="{_sorted_by(cell.value)}"'
    if cell.link:
        text = f'<a href="{_said(cell.link)}">{_said(cell.text)}</a>'
    else:
        text = f"<b>{_said(cell.text)}</b>" if cell.picture else breakable(cell.text)
    small = f" <small>{breakable(cell.small)}</small>" if cell.small else ""
    badges = "".join(f" {badge(word)}" for word in cell.badges)
    if cell.opens:
        badges += f"<details><summary>{_said(cell.opens)}</summary></details>"
    of_kind = f' class="{kind}"' if kind else ""
    return f"<td{value}{of_kind}>{cell.picture}{text}{small}{badges}</td>"


def _sorted_by(value: float | str) -> str:
    return _said(value) if isinstance(value, str) else str(value)


def badge(word: str) -> Markup:
    """A word in a frame; what speaks against a method is coloured."""
    warns = any(what in word for what in ("outdated", "failed", "missing", "unfinished", "below"))
    return Markup(f'<span class="badge{" warn" * warns}">{_said(word)}</span>')


def _said(text: str) -> str:
    """A stranger's text with all its characters to be seen, and nothing but text."""
    return str(escape(cleaned(text, lines=True)))
