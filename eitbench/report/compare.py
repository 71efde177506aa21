"""Paired comparison of two methods: differences, probabilities of improvement, intervals."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pandas as pd

from eitbench import _check
from eitbench._files import bundled_path, resolve_input
from eitbench.bench import records as stored
from eitbench.bench import statistics
from eitbench.bench.scores import scores
from eitbench.bench.table import MISSING, Cell, Table
from eitbench.bench.text import format_interval, format_number, scores_by_seed
from eitbench.bench.tracks import CATEGORIES, nominal_id, qualified_name
from eitbench.report.boards import is_naive_baseline, record_category, skill_scores

Pair = tuple[dict[str, float], dict[str, float]]
"""Scores of a and b by seed."""
SKILL_SCORE = "skill score"
"""Score over several environments instead of the error, whose mean the largest error dominates."""
BUNDLED_RECORDS = bundled_path("leaderboards") / "results"
"""Records of the package."""
OWN_RECORDS = Path("results/records")
"""Records of `eitbench run`."""


def find_records(name: str, folder: Path) -> list[dict[str, Any]]:
    """Return the record in the file NAME.json, or the records METHOD or METHOD@VERSION of the
    first of these that has any: a folder, the package, `OWN_RECORDS`. Without a version the current
    official records are returned, or else the other current ones. The name of an agent without
    training seed, such as ppo, selects its `mean_over_trainings`. ``ValueError`` if no record
    matches, or records of several versions match.
    """
    if name.endswith(".json"):
        return [stored.read_record(resolve_input(Path(name)))]
    method, _, version = name.partition("@")
    known: set[str] = set()
    for place in dict.fromkeys(map(Path.resolve, (folder, BUNDLED_RECORDS, OWN_RECORDS))):
        there = stored.read_records(place)
        known |= {record["method"] for record in there}
        current = there if version else stored.split_outdated(there)[0]
        own = [record for record in current
               if record["method"] == method and version in ("", record["version"])]
        if not version:
            own = [record for record in own if record["official"]] or own or mean_over_trainings(
                [record for record in current if statistics.agent_name(record["method"]) == method])
        versions = sorted({f"{method}@{record['version']}" for record in own})
        if len(versions) > 1:
            raise ValueError(f"{name} fits several versions: {', '.join(versions)}")
        if own:
            return own
    raise ValueError(f"record of {name} not found in {folder}, the package, or {OWN_RECORDS}"
                     + ("" if method in known else _check.did_you_mean(method, known)))


def mean_over_trainings(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a record for each environment and split, with the mean of each score over the training
    seeds of an agent, in the episodes that all of them finished."""
    means = []
    for trainings in stored.group_by(records, _environment_and_split).values():
        found = {name: statistics.mean_by_seed([scores_by_seed(each, name) for each in trainings])
                 for name in scores()}
        episodes = [{"seed": seed, "status": "ok", "scores": {
            name: own[seed] / scores()[name].factor for name, own in found.items() if seed in own}}
            for seed in found["error"]]
        means.append(trainings[0] | {
            "method": statistics.agent_name(trainings[0]["method"]), "episodes": episodes,
            "version": "mean over trainings"})
    return means


def naive_baseline_records(folder: Path) -> list[dict[str, Any]]:
    """Return the current records of naive baselines, of the package and then of a folder."""
    folders = dict.fromkeys([BUNDLED_RECORDS.resolve(), folder.resolve()])
    found = [record for each in folders for record in stored.read_records(each)]
    return stored.split_outdated(list(filter(is_naive_baseline, found)))[0]


def compare(a: list[dict[str, Any]], b: list[dict[str, Any]], score: str = "error",
            zero: Iterable[dict[str, Any]] = ()) -> pd.DataFrame:
    """Compare a score of a and b on the episodes that both finished: a row for each environment,
    and rows for several of them together.

    For the error, the aggregate rows compare skill scores: ``all filter`` and so on, for each
    category with several environments, shifted ones excluded, that have a naive baseline in the
    records ``zero``. For other scores there is one row, ``all``.

    Returns
    -------
    DataFrame
        environment, score (or `SKILL_SCORE`), episodes; a, b: means; advantage of a: b − a if
        lower scores are better, else a − b, with the ends low and high of its 95 % interval;
        better: fraction of episodes in which a is better (an equal score counts ½), with the ends
        better_low and better_high of its interval. Over several environments interquartile means
        of skill scores, or means of the environments' means.

    ``ValueError`` if the score is unknown, or the methods share no finished episode with it.
    """
    known = {each.name: each.direction for each in scores().values()}
    _check.choice("score", score, [name for name in known if known[name] in ("lower", "higher")])
    theirs = {_environment_and_split(record): scores_by_seed(record, score) for record in b}
    levels = {_environment_and_split(record): scores_by_seed(record)
              for record in sorted(zero, key=stored.precedence)}
    pairs: dict[str, Pair] = {}
    gains: dict[str, dict[str, Pair]] = {kind: {} for kind in CATEGORIES}
    for record in sorted(a, key=_environment_and_split):
        key = name, split = _environment_and_split(record)
        own, other = scores_by_seed(record, score), theirs.get(key, {})
        shared = own.keys() & other.keys()
        if not shared:
            continue
        label = name if split == "test" else f"{name} ({split} seeds)"
        own, other = ({seed: each[seed] for seed in shared} for each in (own, other))
        pairs[label] = own, other
        gained, others = (skill_scores(levels.get(key, {}), each) for each in (own, other))
        if gained and not nominal_id(record["environment"]["id"]):
            gains[record_category(record)][label] = gained, others
    if not pairs:
        finished = (f"{len(scores_by_seed(record, score))} episodes of {record['method']} in "
                    f"{qualified_name(record['environment'])}" for record in (*a, *b))
        raise ValueError(f"methods must share an environment and a seed that both finished with "
                         f"{score}; there are {', '.join(finished)}")
    higher = known[score] == "higher"
    rows = [_row(label, score, {label: pair}, statistics.mean_over_environments, higher=higher)
            for label, pair in pairs.items()]
    if score == "error":
        rows += [_row(f"all {kind} ({len(together)} environments)", SKILL_SCORE, together,
                      statistics.interquartile_mean, higher=True)
                 for kind, together in gains.items() if len(together) > 1]
    elif len(pairs) > 1:
        rows.append(_row("all", score, pairs, statistics.mean_over_environments, higher=higher))
    return pd.DataFrame(rows)


def _environment_and_split(record: dict[str, Any]) -> tuple[str, str]:
    return qualified_name(record["environment"]), record["split"]


def _row(label: str, score: str, pairs: dict[str, Pair], statistic: statistics.Statistic, *,
         higher: bool) -> dict[str, Any]:
    """Return a row of `compare`; ``pairs`` are environment -> scores of a and b by seed."""
    ours, theirs = ({name: pair[side] for name, pair in pairs.items()} for side in (0, 1))
    a, b = (float(statistic(*[list(own.values()) for own in side.values()]))
            for side in (ours, theirs))
    difference = statistics.paired_difference(*((ours, theirs) if higher else (theirs, ours)),
                                   statistic=statistic)
    better = statistics.paired_probability_of_improvement(ours, theirs, higher_is_better=higher)
    return {"environment": label, "score": score, "episodes": sum(map(len, ours.values())),
            "a": a, "b": b,
            **dict(zip(("advantage", "low", "high"), difference, strict=True)),
            **dict(zip(("better", "better_low", "better_high"), better, strict=True))}


def comparison_table(table: pd.DataFrame, score: str = "error") -> Table:
    """Return the comparison of the methods A and B; column better has the name of the better one
    where the 95 % interval of the advantage of A excludes zero."""
    rows = []
    for row in table.to_dict("records"):
        share = f"{100 * row['better']:.0f} %"
        if math.isfinite(row["low"]):
            share += f" ({100 * row['better_low']:.0f} to {100 * row['better_high']:.0f} %)"
        kind = f"{SKILL_SCORE} " * (row["score"] == SKILL_SCORE)
        rows.append({
            "environment": row["environment"].removeprefix("eitbench/"),
            "better": "B" if row["high"] < 0 else "A" if row["low"] > 0 else MISSING,
            "episodes": Cell(str(row["episodes"])),
            **{f"{scores()[score].heading} of {key.upper()}": Cell(kind + format_number(row[key]))
               for key in "ab"},
            "advantage of A": Cell(format_interval(row["advantage"], row["low"], row["high"])),
            "A better": Cell(share)})
    return Table.of(rows, label="Comparison", keep=list(rows[0]))


def format_comparison(table: pd.DataFrame, a: dict[str, Any], b: dict[str, Any], score: str,
                      width: int) -> str:
    """Return the comparison of the methods of two records in lines of ``width`` characters. Names
    have versions if they are the same."""
    whole = comparison_table(table, score)
    first = ("environment", "better", "advantage of A", "A better", *whole.headings[3:5])
    fitted = whole.fit_width(width, first)
    names = [each["method"] + f"@{each['version']}" * (a["method"] == b["method"])
             for each in (a, b)]
    hidden = [heading for heading in whole.headings if heading not in fitted.headings]
    return "\n\n".join([f"A: {names[0]}\nB: {names[1]}", fitted.markdown(),
                        *[f"columns omitted: {', '.join(hidden)}"] * bool(hidden)])
