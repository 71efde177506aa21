"""Lines of a table as HTML. A board may have thousands: a template would take minutes for them."""

from __future__ import annotations

from collections.abc import Iterable

from markupsafe import Markup, escape

from eitbench._foreign import cleaned
from eitbench.bench.table import Cell, Row, Table


def rows_html(table: Table, rows: Iterable[Row] | None = None) -> Markup:
    """Lines of a table, each with its end; all, or only some of its ``rows``."""
    kinds = [kind or ("key" if heading == "ẽ_c" else "")
             for kind, heading in zip(table.kinds, table.headings, strict=True)]
    lines = []
    before = ""
    for row in table.rows if rows is None else rows:
        if row.group and row.group != before:
            lines.append(f'<tr><th scope="rowgroup" colspan="{len(kinds)}">{_said(row.group)}'
                         "</th></tr>\n")
        before = row.group
        lines.append(row_html(row, kinds))
    return Markup("".join(lines))


def row_html(row: Row, kinds: list[str]) -> str:
    """One line; ``kinds`` are the classes of its cells, empty for none."""
    flags = f' data-flags="{_said(row.flags)}"' if row.flags else ""
    cells = "".join(map(_cell, row.cells, kinds))
    return f"<tr{flags}>{cells}</tr>\n"


def breakable(text: str) -> str:
    """A long name may break after its underscores and before its version, but ẽ_c may not."""
    said = str(escape(text)).replace("_", "_<wbr/>").replace("ẽ_<wbr/>", "ẽ_")
    return said.replace("@", "<wbr/>@")


def _cell(cell: Cell, kind: str) -> str:
    value = "" if cell.value is None else f' data-value="{_said(str(cell.value))}"'
    if cell.link:
        text = f'<a href="{_said(cell.link)}">{_said(cell.text)}</a>'
    else:
        text = f"<b>{_said(cell.text)}</b>" if cell.picture else breakable(cell.text)
    small = f" <small>{breakable(cell.small)}</small>" if cell.small else ""
    badges = "".join(f" {badge(word)}" for word in cell.badges)
    of_kind = f' class="{kind}"' if kind else ""
    return f"<td{value}{of_kind}>{cell.picture}{text}{small}{badges}</td>"


def badge(word: str) -> Markup:
    """A word in a frame; what speaks against a method is coloured."""
    warns = word == "outdated" or "failed" in word or "missing" in word
    return Markup(f'<span class="badge{" warn" * warns}">{_said(word)}</span>')


def _said(text: str) -> str:
    """A stranger's text with all its characters to be seen, and nothing but text."""
    return str(escape(cleaned(text, lines=True)))
