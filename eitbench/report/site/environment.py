"""The page of an environment: its board in full, its charts, and its documentation."""

from __future__ import annotations

import re
from urllib.parse import quote

from markdown_it import MarkdownIt
from markupsafe import Markup

from eitbench.bench.tracks import home_of, named
from eitbench.envs.pages import page
from eitbench.report import figures
from eitbench.report.model import Board
from eitbench.report.site.beside import Beside
from eitbench.report.site.collect import ROBUSTNESS, Site
from eitbench.report.tables import Axes, explanations, page_table
from eitbench.report.templates import template


def environment_page(site: Site, board: Board, beside: Beside) -> bytes:
    """Return the HTML of the page, which offers to play the animation ``beside`` the site."""
    id = next(row.record["environment"]["id"] for row in board.rows if row.record)
    table = page_table(board, "../")
    description, details = documentation(id)
    animation = f"{board.environment}.webp"
    return template("site/environment.html.j2").render(
        root="../", links=beside.links("../"), season=site.season.number, board=board, id=id,
        table=table, axes=Axes.of(board).drawn(), explanations=explanations([table]),
        description=description, details=details,
        intervals=figures.error_chart(board), front=figures.cost_chart(board),
        curves=figures.curve_chart(board),
        moving=beside.picture(quote(animation), "../"),
        media_mb=f"{1e-6 * beside.media.get(animation, 0):.1f} MB",
        robustness=ROBUSTNESS if home_of(id) and named(id, {}) == board.environment else "",
        siblings=[other for other in site.classes[board.of_class]
                  if other is not board and not other.is_aggregate]).encode()


def documentation(id: str) -> tuple[Markup, Markup]:
    """Return the description of an id and the remaining sections of its page, as HTML."""
    text = re.sub(r"\A\s*## Description\s*", "", page(id))
    first, rest = re.split(r"^(?=## |\|)", text, maxsplit=1, flags=re.MULTILINE)
    return markdown(first), markdown(rest)


def markdown(text: str) -> Markup:
    """Return HTML of a text with tables, its headings one level lower; HTML and links in it are
    plain text."""
    reader = MarkdownIt("commonmark", {"html": False}).enable("table")
    reader.disable(["link", "image", "autolink"])
    tokens = reader.parse(text)
    for token in tokens:
        if token.type in ("heading_open", "heading_close"):
            token.tag = f"h{min(int(token.tag[1]) + 1, 6)}"
    html = reader.renderer.render(tokens, reader.options, {})
    begin = '<div class="card" tabindex="0" role="region" aria-label="table"><table>'
    return Markup(html.replace("<table>", begin).replace("</table>", "</table></div>"))
