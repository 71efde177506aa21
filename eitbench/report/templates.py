"""Jinja templates of all pages; text from records is escaped."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import jinja2
from markdown_it import MarkdownIt
from markupsafe import Markup, escape
from PIL import Image

from eitbench._sanitize import escape_markdown, sanitize

if TYPE_CHECKING:
    from matplotlib.figure import Figure

N_COLOURS = 12
"""--c0 … --c11 of the style sheet; further series repeat them, dashed."""


def render_template(name: str, /, **contents: Any) -> bytes:
    """Return the page that one of the templates in this folder makes of its contents."""
    return _environment().get_template(name).render(**contents).encode()


@lru_cache(maxsize=1)
def _environment() -> jinja2.Environment:
    made = jinja2.Environment(loader=jinja2.PackageLoader("eitbench.report", "."), autoescape=True,
                              trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
                              undefined=jinja2.StrictUndefined, finalize=_finalize)
    made.globals |= {"add_line_breaks": add_line_breaks, "n_colours": N_COLOURS}
    made.filters |= {"tick": format_tick, "escape_markdown": escape_markdown}
    return made


def macro(name: str) -> Callable[..., Markup]:
    """Return a macro of the template of charts."""
    drawing = _environment().get_template("charts.svg.j2").module
    found: Callable[..., Markup] = getattr(drawing, name)
    return found


def format_tick(tick: float) -> str:
    """``200,000`` and ``0.002``, never ``2e+05``."""
    return f"{tick:,.0f}" if abs(tick) >= 1e4 else f"{tick:g}"


def _finalize(value: Any) -> Any:
    """Return text with control characters spelt out, and markup as it is."""
    return sanitize(value, lines=True) if type(value) is str else value


def add_line_breaks(text: str) -> Markup:
    """Return HTML of a name that may break after underscores and slashes and before @, ẽ_c
    excepted."""
    html = str(escape(_finalize(text)))
    html = html.replace("_", "_<wbr/>").replace("ẽ_<wbr/>", "ẽ_").replace("@", "<wbr/>@")
    return Markup(re.sub(r"/(?=\w{3})", "/<wbr/>", html))


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


def figure_image(figure: Figure) -> Image.Image:
    """Return a figure as a picture."""
    content = io.BytesIO()
    figure.savefig(content, format="png")
    return Image.open(content)


def data_uri(image: Image.Image, kind: str = "png", **options: Any) -> str:
    """Return a picture as an address that holds it."""
    content = io.BytesIO()
    image.save(content, kind, **options)
    return f"data:image/{kind};base64," + base64.b64encode(content.getvalue()).decode()
