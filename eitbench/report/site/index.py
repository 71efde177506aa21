"""The first page: every board, class by class."""

from __future__ import annotations

from eitbench.bench.records import finished
from eitbench.report.site.beside import HEADLINE, Beside
from eitbench.report.site.collect import MEASURED, ROBUSTNESS, Site
from eitbench.report.site.headline import headline, key_figures
from eitbench.report.site.measured import Measured
from eitbench.report.site.robustness import families
from eitbench.report.tables import Axes, explanations, page_table
from eitbench.report.templates import template

ABOUT = {
    "filter": "Estimates of each moment from the measurements until then.",
    "fixed-lag": "Estimates of each moment from the measurements until a few later.",
    "smoothing": "Estimates of each moment from the whole record.",
    "stationary": "Targets that stand still.",
    "injection": "The next current is chosen; a Kalman filter inside makes the estimate.",
}
"""Class -> task."""


def index_page(site: Site, beside: Beside, measured: Measured) -> bytes:
    """Return the HTML of ``index.html``."""
    tables = {board.anchor: page_table(board, "", compact=True) for board in site.boards}
    classes = [{"name": name, "about": ABOUT[name],
                "boards": [(board, tables[board.anchor], Axes.of(board).drawn())
                           for board in boards]} for name, boards in site.classes.items()]
    top = headline(site)
    return template("site/index.html.j2").render(
        root="", links=beside.links(""), headline=top,
        figures=[*([top.figure] if top else []), *key_figures(site)],
        moving=beside.picture(HEADLINE[0], ""), still=beside.picture(HEADLINE[1], ""),
        n_environments=sum(not board.is_aggregate for board in site.boards),
        n_records=len(site.records),
        n_methods=len({record["method"] for record in site.records}), classes=classes,
        robustness=ROBUSTNESS if families(site) else "",
        measured=MEASURED if measured.records else "",
        last=max(map(finished, site.records), default="")[:10],
        explanations=explanations(tables.values())).encode()
