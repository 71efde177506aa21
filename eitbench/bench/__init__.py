"""Methods, runs, scores, records and verification of the benchmark."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from eitbench._extras import require_extra

if TYPE_CHECKING:
    import pandas as pd

_COLUMNS = ("environment", "board", "method", "version", "title", "role", "privileged", "official",
            "outdated", "split", "seed", "status", "metric", "value")


def load(folder: Path | str | None = None, *, measured: bool = False) -> pd.DataFrame:
    """Load all records of a folder as a tidy table: one row for each score of each episode.

    The default folder is ``leaderboards/results``, the published records, or the table of their
    episodes where only that is installed. Records of ``measured`` cases are in a checkout only.

    Returns
    -------
    DataFrame
        environment, board, method, version, title, role, privileged, official, outdated, split,
        seed, status, metric, value. Metrics have the names and units of
        ``leaderboards/schema.json`` (s, V², bytes). A failed episode has one row, with the metric
        error and no value. ``outdated`` marks records of a superseded version of a built-in method.

    ``ValueError``, naming the folder if it is missing, or a file that is not a valid record.
    """
    with require_extra("eitbench.leaderboard.load"):
        import pandas as pd

        from eitbench._files import bundled_path
        from eitbench.bench.episode_table import table_path
        from eitbench.bench.records import read_records, read_valid_files, split_outdated
    path = Path(folder or bundled_path("leaderboards") / "results")
    if not path.is_dir() and not table_path(path).is_file():
        raise ValueError(f"folder must hold records, got {path}, which does not exist")
    records = read_records(path)
    if measured:
        records += read_valid_files(path, measured=True)[0].values()
    groups = split_outdated(records)
    rows = [row for group, outdated in zip(groups, (False, True), strict=True)
            for record in group for row in _rows(record, outdated)]
    types = dict.fromkeys(("privileged", "official", "outdated"), bool) | {"value": float}
    return pd.DataFrame(rows, columns=list(_COLUMNS)).astype(types)


def _rows(record: dict[str, Any], outdated: bool) -> Iterator[tuple[Any, ...]]:
    from eitbench.bench.tracks import qualified_name
    fields = record | {"environment": qualified_name(record["environment"]), "outdated": outdated}
    first = tuple(fields[name] for name in _COLUMNS[:10])
    for episode in record["episodes"]:
        scores = {"error": math.nan}
        if episode["status"] == "ok":
            scores = episode["scores"] | {"peak_memory": episode["peak_memory"]}
        for metric, value in scores.items():
            if value is not None:
                yield *first, episode["seed"], episode["status"], metric, value
