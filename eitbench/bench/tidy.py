"""Records as one table, a row for each score of each episode: what `eitbench.bench.load` gives."""

from __future__ import annotations

import math
from pathlib import Path

import pandas as pd

from eitbench._files import shipped
from eitbench.bench.records import newest, read_records

COLUMNS = ("environment", "board", "method", "version", "title", "role", "privileged", "official",
           "outdated", "split", "seed", "status", "metric", "value")
_OF_RECORDS = ("board", "method", "version", "title", "role", "privileged", "official", "split")


def tidy(folder: Path | str | None = None) -> pd.DataFrame:
    """The table; `eitbench.bench.load` says what is in it."""
    rows = []
    groups = newest(read_records(Path(folder or shipped("leaderboards") / "results")))
    for group, outdated in zip(groups, (False, True), strict=True):
        for record in group:
            shared = {name: record[name] for name in _OF_RECORDS} | {
                "environment": record["environment"]["name"], "outdated": outdated}
            for episode in record["episodes"]:
                scores = {"error": math.nan}
                if episode["status"] == "ok":
                    scores = episode["scores"] | {"peak_memory": episode["peak_memory"]}
                own = shared | {"seed": episode["seed"], "status": episode["status"]}
                rows += [own | {"metric": metric, "value": value}
                         for metric, value in scores.items() if value is not None]
    return pd.DataFrame(rows, columns=list(COLUMNS)).astype(
        dict.fromkeys(("privileged", "official", "outdated"), bool) | {"value": float})
