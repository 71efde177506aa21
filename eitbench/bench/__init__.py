"""Floor 6: run methods on environments, keep what came out, and report it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from eitbench._extras import needed_by

if TYPE_CHECKING:
    import pandas as pd


def load(folder: Path | str | None = None) -> pd.DataFrame:
    """All records of a folder as a tidy table: one row for each score of each episode.

    Parameters
    ----------
    folder : path
        Default: the published records, ``leaderboards/results``.

    Returns
    -------
    DataFrame
        environment, board, method, version, title, role, privileged, official, outdated, split,
        seed, status, metric, value. Metrics are named and measured as in
        ``leaderboards/schema.json`` (s, V², bytes). A failed episode has one row, with the metric
        error and no value. ``outdated`` are records of an earlier version of a method of ours than
        there is one of: not to be mixed with the others.

    Raises
    ------
    ValueError
        Naming the file, if one is no valid record.
    """
    with needed_by("eitbench.leaderboard.load"):
        from eitbench.bench.tidy import tidy
    return tidy(folder)
