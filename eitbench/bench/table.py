"""Tables of text cells with sorting keys, for Markdown, terminals and HTML pages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from markupsafe import Markup

from eitbench._sanitize import escape_markdown
from eitbench.bench.text import format_mean, format_number, mean_and_interval

MISSING = "–"


class Cell(NamedTuple):
    """One cell of a table."""

    text: str
    value: float | str | None = None
    """Sorting key: a text for words, a number for numbers; None is sorted last."""
    picture: Markup = Markup()
    link: str = ""
    note: str = ""
    """Secondary text."""
    badges: tuple[str, ...] = ()

    @property
    def plain_text(self) -> str:
        """All text of the cell."""
        text = " ".join(filter(None, [self.text, self.note]))
        return text + (f" ({', '.join(self.badges)})" if self.badges else "")


class Row(NamedTuple):
    """One row of a table."""

    cells: list[Cell]
    flags: str = ""
    """Keywords for the table filters of a page, separated by spaces."""
    children: tuple[Row, ...] = ()
    """Rows that this one summarises, initially collapsed."""


class Table(NamedTuple):
    """Headings and rows."""

    headings: list[str]
    rows: list[Row]
    label: str = ""

    @classmethod
    def of(cls, rows: Iterable[Mapping[str, Cell | str]], *, label: str = "",
           flags: Sequence[str] = (), keep: Sequence[str] = ()) -> Table:
        """Make a table from mappings heading -> cell, all with the same headings; a string becomes
        a cell of words. Empty columns are omitted unless listed in ``keep``."""
        made = [{heading: cell if isinstance(cell, Cell) else Cell(cell, cell)
                 for heading, cell in row.items()} for row in rows]
        headings = [heading for heading in (made[0] if made else ())
                    if heading in keep or any(row[heading].plain_text != MISSING for row in made)]
        return cls(headings, [Row([row[heading] for heading in headings], flags[i] if flags else "")
                              for i, row in enumerate(made)], label)

    @property
    def column_styles(self) -> list[str]:
        """Style of each column: ``drawn`` for intervals, ``words``, or empty for numbers."""
        columns = [[row.cells[i] for row in self.rows] for i in range(len(self.headings))]
        return ["drawn" if any(cell.picture for cell in column)
                else "words" if any(isinstance(cell.value, str) for cell in column) else ""
                for column in columns]

    def fit_width(self, width: int, order: Sequence[str]) -> Table:
        """Return the table without the columns for which ``width`` characters are too few: columns
        that are not in ``order`` are omitted first, then the last in ``order``."""
        table = self
        ranked = dict.fromkeys([each for each in order if each in self.headings] + self.headings)
        for heading in list(ranked)[:0:-1]:
            if len(table.markdown().partition("\n")[0]) <= width:
                break
            i = table.headings.index(heading)
            rows = [row._replace(cells=row.cells[:i] + row.cells[i + 1:]) for row in table.rows]
            table = Table(table.headings[:i] + table.headings[i + 1:], rows, table.label)
        return table

    def markdown(self) -> str:
        """Return aligned Markdown."""
        texts = [self.headings, *([cell.plain_text for cell in row.cells] for row in self.rows)]
        lines = [[escape_markdown(text) for text in line] for line in texts]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        sides = ["<" if style == "words" else ">" for style in self.column_styles]
        rule = "|".join(f"{'-' * width}-{'-' if side == '<' else ':'}"
                        for width, side in zip(widths, sides, strict=True))
        padded = [" | ".join(f"{text:{side}{width}}" for text, width, side
                             in zip(line, widths, sides, strict=True)) for line in lines]
        first, *others = [f"| {line} |" for line in padded]
        return "\n".join([first, f"|{rule}|", *others])


def number_cell(value: float | None) -> Cell:
    """Return the cell of a number, `MISSING` for None and NaN."""
    if value is None or value != value:
        return Cell(MISSING)
    return Cell(format_number(value), float(value))


def mean_cell(values: Iterable[float]) -> Cell:
    """Return the cell of a mean ± half its 95 % interval, `MISSING` without values."""
    known = list(values)
    if not known:
        return Cell(MISSING)
    mean, half = mean_and_interval(known)
    return Cell(format_mean(mean, half), mean)
