"""Records as one table, a row for each score of each episode: what `eitbench.bench.load` gives."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from eitbench._files import shipped
from eitbench.bench.records import newest, read_records

COLUMNS = ("environment", "board", "method", "version", "title", "role", "privileged", "official",
           "outdated", "split", "seed", "status", "metric", "value")
_OF_RECORDS = COLUMNS[:10]
_OF_EPISODES = COLUMNS[10:12]


def tidy(folder: Path | str | None = None) -> pd.DataFrame:
    """The table; `eitbench.bench.load` says what is in it."""
    path = Path(folder or shipped("leaderboards") / "results")
    groups = newest(read_records(path, keep=_without_steps))
    records: list[tuple[Any, ...]] = []
    episodes: list[tuple[str, str]] = []
    record_of: list[int] = []
    """each episode"""
    lengths: list[int] = []
    """of each episode in rows"""
    metrics: list[str] = []
    values: list[float] = []
    for group, outdated in zip(groups, (False, True), strict=True):
        for record in group:
            own = record | {"environment": record["environment"]["name"], "outdated": outdated}
            for episode in record["episodes"]:
                scores = _scores(episode)
                metrics += scores
                values += scores.values()
                lengths.append(len(scores))
                episodes.append((episode["seed"], episode["status"]))
            record_of += [len(records)] * len(record["episodes"])
            records.append(tuple(own[name] for name in _OF_RECORDS))
    # each text is there once, and rows point to it: millions of them are made at once
    rows = np.repeat(np.arange(len(episodes)), lengths)
    named, codes = np.unique(np.array(metrics, dtype=object), return_inverse=True)
    parts = [(pd.DataFrame(records, columns=list(_OF_RECORDS)), np.array(record_of, int)[rows]),
             (pd.DataFrame(episodes, columns=list(_OF_EPISODES)), rows),
             (pd.DataFrame({"metric": named}), codes)]
    table = pd.concat([part.take(places).reset_index(drop=True) for part, places in parts], axis=1)
    return table.assign(value=values).astype(_TYPES)


_TYPES = dict.fromkeys(("privileged", "official", "outdated"), bool) | {"value": float}


def _scores(episode: dict[str, Any]) -> dict[str, float]:
    """Those that it has; of a failed one that it has no error."""
    if episode["status"] != "ok":
        return {"error": math.nan}
    scores = episode["scores"] | {"peak_memory": episode["peak_memory"]}
    return {metric: value for metric, value in scores.items() if value is not None}


def _without_steps(record: dict[str, Any]) -> dict[str, Any]:
    """The error of each step is most of a record, and in no row."""
    for episode in record["episodes"]:
        episode.pop("step_errors", None)
    return record
