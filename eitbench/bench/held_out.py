"""Episodes that nobody could prepare for: their seeds follow from a salt that only the maintainers
know.

Held-out episode k = 0, 1, … has the seed SHA-256(salt ‖ k) mod 2⁶³, k as eight bytes, the first the
highest. The salt's own SHA-256 is published, so that it cannot be chosen after a method was seen
(`eitbench.bench.salts`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from eitbench.bench.methods import is_ours
from eitbench.bench.records import version_number
from eitbench.bench.run import Job, run_episode
from eitbench.bench.statistics import FEWEST
from eitbench.bench.table import Cell, Table
from eitbench.bench.text import scores_by_seed
from eitbench.bench.too_good import judged, too_good
from eitbench.bench.tracks import FLOORS
from eitbench.data.seasons import drawn_seeds
from eitbench.data.seeds import parse_seeds


class Plays(NamedTuple):
    """What is played to judge a record: no record of the floor is believed."""

    own: list[Job]
    """The method in held-out episodes."""
    beside: list[Job]
    """The board's floor in the same."""
    there: list[Job]
    """The floor in the record's episodes that the method has finished."""


def plays(record: dict[str, Any], job: Job, salt: bytes, episodes: int) -> Plays:
    """What is to be played to judge a record by so many held-out episodes.

    Parameters
    ----------
    record, job
        As read, and what `verify.job_of` makes of it.
    salt : bytes
        As read by `salts.read_published_salt`.
    episodes : int
        How many held-out episodes the method and the board's floor play.

    Raises
    ------
    ValueError
        If the episodes are too few to judge, or the method is a stranger's and could reach their
        seeds.
    """
    if not is_ours(job.method) and job.isolation != "landlock":
        raise ValueError(f"{job.method} is not ours and can play held-out episodes behind a wall "
                         f"only, Landlock's; here isolation is {job.isolation}")
    errors = scores_by_seed(record, "error")
    if min(episodes, len(errors)) < 2 or episodes + len(errors) < FEWEST:
        raise ValueError(f"held-out episodes and those of the record must be {FEWEST} together, "
                         f"and two each, to be compared; got {episodes} and {len(errors)}")
    floor = Job(job.environment, FLOORS[job.environment.track], 0)
    seeds = drawn_seeds(salt, episodes)
    return Plays([job._replace(seed=seed) for seed in seeds],
                 [floor._replace(seed=seed) for seed in seeds],
                 [floor._replace(seed=parse_seeds(name)[0]) for name in errors])


def verdict(record: dict[str, Any], own: list[dict[str, Any]], beside: list[dict[str, Any]],
            there: list[dict[str, Any]]) -> tuple[str, list[str]]:
    """Whether what a record says is better than what its method does in held-out episodes.

    Parameters
    ----------
    record
        As read.
    own, beside, there
        The results of its `plays`, in their order.

    Returns
    -------
    table, differences
        Markdown, and a sentence for each thing that is not as the record says;
        `too_good.judged` says how the two are compared.
    """
    errors = scores_by_seed(record, "error")
    said = [{"status": "ok", "scores": {"error": error}} for error in errors.values()]
    differences = [f"failed in a held-out episode: {result['message']}"
                   for result in (*own, *beside) if result["status"] == "failed"]
    if version_number(record["version"]) is None:  # whose file was looked at some time ago
        played = {result["method_sha256"] for result in own if "method_sha256" in result}
        differences += [f"the file that played has the sha256 {other}, that of the record has "
                        f"{record['method_sha256']}"
                        for other in sorted(played - {record["method_sha256"]})]
    differences += [f"the floor failed in {name}: {result['message']}"
                    for name, result in zip(errors, there, strict=True)
                    if result["status"] == "failed"]
    record_pairs = _pairs(said, there)
    new_pairs = _pairs(own, beside)
    if min(len(record_pairs), len(new_pairs)) < 2:
        return "", differences
    found = judged(record_pairs, new_pairs)
    rows: list[dict[str, Cell | str]] = [
        {"compared with the floor": finding.name,
         f"record, {len(record_pairs)} episodes": Cell(f"{finding.record:.3g}"),
         f"held-out, {len(new_pairs)}": Cell(f"{finding.held_out:.3g}"),
         "p": Cell(f"{finding.p:.2g}")} for finding in found]
    differences += [f"{finding.name}: {finding.record:.3g} in the record, {finding.held_out:.3g} "
                    f"held-out; so much better is an honest record with p = {finding.p:.2g}"
                    for finding in too_good(found)]
    return Table.of(rows).markdown(), differences


def held_out(record: dict[str, Any], todo: Plays) -> tuple[str, list[str]]:
    """Play all that is to be played here and now, one after the other; the `verdict`."""
    return verdict(record, *([run_episode(job)[0] for job in jobs] for jobs in todo))


def _pairs(own: list[dict[str, Any]], floor: list[dict[str, Any]]) -> np.ndarray:
    """(n, 2) ẽ_c of a method and of the floor, of the episodes that both finished."""
    pairs = [(a["scores"]["error"], b["scores"]["error"]) for a, b in zip(own, floor, strict=True)
             if a["status"] == b["status"] == "ok"]
    return np.array([pair for pair in pairs if pair[1] > 0.0]).reshape(-1, 2)
