"""One model of a table: cells of text with the number to sort by. It becomes Markdown here, which
is also what a terminal shows, and HTML in the pages of `eitbench.report`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from markupsafe import Markup

from eitbench._foreign import as_markdown
from eitbench.bench.text import number

NOTHING = "–"


class Cell(NamedTuple):
    """What one method has in one column."""

    text: str
    value: float | str | None = None
    """What to sort by; None comes last. Words are sorted by a text, numbers by a number."""
    picture: Markup = Markup()
    link: str = ""
    small: str = ""
    """Said after the text, quietly."""
    badges: tuple[str, ...] = ()
    opens: str = ""
    """What a click shows: the parts of its line, by this name."""

    @property
    def plain(self) -> str:
        """All that it says, without picture and link."""
        said = " ".join(filter(None, [self.text, self.small]))
        return said + (f" ({', '.join(self.badges)})" if self.badges else "")


class Row(NamedTuple):
    """A line of a table."""

    cells: list[Cell]
    flags: str = ""
    """What the toggles of a page go by, separated by spaces."""
    group: str = ""
    """Lines of one group follow each other, below its name."""
    parts: tuple[Row, ...] = ()
    """Lines that it stands for, shown where they are asked for."""


class Table(NamedTuple):
    """Headings, and under them the cells of each row."""

    headings: list[str]
    rows: list[Row]
    label: str = ""

    @classmethod
    def of(cls, rows: Iterable[Mapping[str, Cell | str]], *, label: str = "",
           flags: Sequence[str] = (), groups: Sequence[str] = (),
           keep: Sequence[str] = ()) -> Table:
        """From a mapping heading -> cell for each row, all with the same headings; a text stands
        for a cell of words. Columns in which there is nothing are left out, but for those to
        ``keep``."""
        made = [{heading: _cell(cell) for heading, cell in row.items()} for row in rows]
        headings = [heading for heading in (made[0] if made else ())
                    if heading in keep or any(row[heading].plain != NOTHING for row in made)]
        lines = [Row([row[heading] for heading in headings],
                     flags[i] if flags else "", groups[i] if groups else "")
                 for i, row in enumerate(made)]
        return cls(headings, lines, label)

    @property
    def kinds(self) -> list[str]:
        """Of each column, for the style sheet: with ``drawn`` intervals, of ``words``, or of
        numbers, which is empty."""
        return [_kind([row.cells[i] for row in self.rows]) for i in range(len(self.headings))]

    def fitted(self, width: int, order: Sequence[str] = ()) -> Table:
        """With as many columns as lines of ``width`` letters hold; what is not in ``order`` goes
        first, the last column before the others, then what stands last there. The first of the
        ``order`` stays."""
        def place(heading: str) -> tuple[int, int]:
            at = order.index(heading) if heading in order else len(order)
            return at, self.headings.index(heading)

        table = self
        for heading in sorted(self.headings, key=place)[:0:-1]:
            if len(table.markdown().partition("\n")[0]) <= width:
                break
            table = table._without(heading)
        return table

    def _without(self, heading: str) -> Table:
        i = self.headings.index(heading)
        rows = [row._replace(cells=row.cells[:i] + row.cells[i + 1:]) for row in self.rows]
        return self._replace(headings=self.headings[:i] + self.headings[i + 1:], rows=rows)

    def markdown(self) -> str:
        """Also pleasant to read in a terminal."""
        said = [self.headings, *([cell.plain for cell in row.cells] for row in self.rows)]
        lines = [[as_markdown(text) for text in line] for line in said]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        words = [kind == "words" for kind in self.kinds]

        def padded(line: list[str]) -> str:
            cells = (text.ljust(width) if left else text.rjust(width)
                     for text, width, left in zip(line, widths, words, strict=True))
            return f"| {' | '.join(cells)} |"

        rule = "|".join("-" * (width + 2) if left else "-" * (width + 1) + ":"
                        for width, left in zip(widths, words, strict=True))
        return "\n".join([padded(lines[0]), f"|{rule}|", *map(padded, lines[1:])])


def number_cell(value: float | None) -> Cell:
    """A number, shortly; None and what is not a number are nothing."""
    return Cell(NOTHING) if value is None or value != value else Cell(number(value), float(value))


def _cell(said: Cell | str) -> Cell:
    return said if isinstance(said, Cell) else Cell(said, said)


def _kind(column: list[Cell]) -> str:
    if any(cell.picture for cell in column):
        return "drawn"
    return "words" if any(isinstance(cell.value, str) for cell in column) else ""
