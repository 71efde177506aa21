"""The first page: every board, class by class."""

from __future__ import annotations

from typing import Any

from eitbench.bench.records import finished
from eitbench.report.site.beside import HEADLINE, Beside
from eitbench.report.site.collect import MEASURED, ROBUSTNESS, Site, about_season
from eitbench.report.site.headline import headline, numbers
from eitbench.report.site.measured import Measured
from eitbench.report.site.robustness import families
from eitbench.report.site.tables import axes, explanations, more, rows_file, table
from eitbench.report.templates import template

ABOUT = {
    "filter": "Where is what now? The estimate of each moment, from the measurements until then.",
    "fixed-lag": "The same a few measurements later.",
    "smoothing": "Every moment, once the whole record is known.",
    "stationary": "Targets that stand still.",
    "injection": "Which current to inject next; a Kalman filter inside makes the estimate.",
}
"""What each class asks for."""


def index_pages(site: Site, beside: Beside, measured: Measured) -> dict[str, bytes]:
    """The HTML of ``index.html``, and the lines for which it has no room."""
    made = {board.anchor: table(board, "", compact=True) for board in site.boards}
    longer = {anchor: more(each, anchor, "") for anchor, each in made.items()}
    classes: list[dict[str, Any]] = [{
        "name": name, "about": ABOUT[name],
        "boards": [(board, made[board.anchor], longer[board.anchor], axes(board))
                   for board in site.boards if board.of_class == name],
    } for name in site.classes]
    html = template("site/index.html.j2").render(
        root="", links=beside.links(""), headline=headline(site), numbers=numbers(site),
        moving=beside.picture(HEADLINE[0], ""), still=beside.picture(HEADLINE[1], ""),
        n_environments=sum(not board.is_aggregate for board in site.boards),
        n_records=len(site.records), n_methods=len(site.methods), classes=classes,
        season=about_season(site.season), robustness=ROBUSTNESS if families(site) else "",
        measured=MEASURED if measured.records else "",
        last=max(map(finished, site.records), default="")[:10],
        explanations=explanations(list(made.values())))
    return {"index.html": html.encode()} | {
        each.file: rows_file(made[anchor], each.file) for anchor, each in longer.items() if each}
