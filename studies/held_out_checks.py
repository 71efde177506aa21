"""How often an honest record fails against held-out episodes, and how small a cheat still passes:
`python studies/held_out_checks.py`, two minutes.

Honest records are made of the published ones, in three ways: 10 episodes of the 30 or 50 of a
record are called the record and the others held-out, as they are; or both are drawn from a smooth
population like it (episodes drawn again, logarithms of the ratio to the floor moved by a kernel);
or, for the single-episode test, each episode of every record is compared with the others of it.
Cheats are a Kalman filter in Pipe2D-v0 with a record of ten episodes, of which some are better than
it can do; and methods whose record is that of a better one.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.stats import t as student
from threadpoolctl import threadpool_limits

from eitbench._files import shipped
from eitbench.bench.records import read_records
from eitbench.bench.text import scores_by_seed
from eitbench.bench.too_good import judged, too_good
from eitbench.bench.tracks import FLOORS, track_of_board

DRAWS = 1000
REPEATS = 400
HELD_OUT = (10, 30, 100)
CHEATS: tuple[tuple[str, int, float], ...] = (
    ("the truth of the hardest", 1, 0.0), ("the truth of the two hardest", 2, 0.0),
    ("half the error of the hardest", 1, 0.5), ("half of the two hardest", 2, 0.5),
    ("30 % less in the two hardest", 2, 0.7), ("30 % less in five", 5, 0.7),
    ("30 % less in all", 10, 0.7), ("20 % less in all", 10, 0.8), ("10 % less in all", 10, 0.9))
"""What is known, of how many of the ten episodes, and what is left of their error."""
PRETENDERS = (("Pipe2D", "extended_kalman_filter", "kalman_filter", 20),
              ("Pipe2DInjectionFaults", "fault_aware", "best_cycle", 50),
              ("Pipe2DInjectionBudget", "event_triggered", "best_cycle", 20),
              ("Pipe2DInjectionBudget", "event_triggered", "best_cycle", 100))
"""World, what the record says, what the method is, held-out episodes."""


def main() -> None:
    populations = dict(published())
    splits = [pairs for pairs in populations.values() if len(pairs) >= 30]
    random = np.random.default_rng(0)
    print("| honest records | held-out episodes | too good, of 100 | of them by mean, gain, single "
          "|\n|---|---:|---:|---|")
    print(share("10 of 30 or 50 episodes against the others", "20 or 40",
                [split(random, random.choice(len(splits)), splits) for _ in range(5 * REPEATS)]))
    enough = [pairs for pairs in populations.values() if len(pairs) >= 10]
    for count in HELD_OUT:
        print(share("10 of a smooth population", str(count), [
            (like(random, pairs, 10), like(random, pairs, count))
            for pairs in (enough[random.choice(len(enough))] for _ in range(5 * REPEATS))]))
    low, high = tails([pairs for pairs in populations.values() if len(pairs) >= 6])
    print(f"\nOf {len(low)} single episodes, below the prediction interval of the others of their "
          "record, and above:")
    for level in (0.05, 0.01, 0.001):
        print(f"- at {100 * level:g} %: {100 * (low < level).mean():.2g} % and "
              f"{100 * (high < level).mean():.2g} %")
    filter_ = populations["eitbench-Pipe2D-v0", "kalman_filter"]
    print("\n| a Kalman filter that has | its mean error falls by | found with 10 held-out "
          "| with 30 | with 100 |\n|---|---:|---:|---:|---:|")
    for what, count, left in CHEATS:
        rates = []
        falls = []
        for number in HELD_OUT:
            made = [(like(random, filter_, 10), like(random, filter_, number))
                    for _ in range(REPEATS)]
            prepared = [(cheat(pairs, count, left), new) for pairs, new in made]
            rates.append(rate(prepared))
            falls += [1.0 - b[:, 0].mean() / a[:, 0].mean()
                      for (a, _), (b, _) in zip(made, prepared, strict=True)]
        found = " | ".join(f"{100 * each:.0f}" for each in rates)
        print(f"| {what} | {100 * float(np.mean(falls)):.0f} % | {found} |")
    print("\n| record of | method | held-out episodes | found, of 100 |\n|---|---|---:|---:|")
    for world, said, true, number in PRETENDERS:
        a, b = (populations[f"eitbench-{world}-v0", name] for name in (said, true))
        cases = [(like(random, a, len(a)), like(random, b, number)) for _ in range(REPEATS)]
        print(f"| {world}, {said} | {true} | {number} | {100 * rate(cases):.0f} |")


def published() -> Iterator[tuple[tuple[str, str], np.ndarray]]:
    """Environment and method -> (n, 2) ẽ_c of it and of its floor."""
    records = read_records(shipped("leaderboards") / "results")
    errors = {(record["environment"]["name"], record["method"]): scores_by_seed(record, "error")
              for record in records}
    for record in records:
        name = record["environment"]["name"]
        floor = FLOORS[track_of_board(record["board"])]
        if record["method"] != floor:
            own, zero = errors[name, record["method"]], errors[name, floor]
            shared = [seed for seed in own if seed in zero]
            yield ((name, record["method"]),
                   np.array([[own[seed], zero[seed]] for seed in shared]))


def split(random: np.random.Generator, which: int, populations: list[np.ndarray],
          ) -> tuple[np.ndarray, np.ndarray]:
    """Ten episodes and the others, of one record."""
    mixed = random.permutation(populations[which])
    return mixed[:10], mixed[10:]


def like(random: np.random.Generator, pairs: np.ndarray, n: int) -> np.ndarray:
    """(n, 2) from a smooth population with the mean and spread of the logarithms of the pairs."""
    logarithms = np.log(np.stack([pairs[:, 0] / pairs[:, 1], pairs[:, 1]], axis=1))
    mean = logarithms.mean(axis=0)
    spread = logarithms.std(axis=0, ddof=1)
    width = 1.06 * len(pairs) ** -0.2
    drawn = logarithms[random.integers(len(pairs), size=n)]
    moved = drawn - mean + width * spread * random.normal(size=drawn.shape)
    ratio, floor = np.exp(mean + moved / np.hypot(1.0, width)).T
    return np.stack([ratio * floor, floor], axis=1)


def cheat(pairs: np.ndarray, count: int, left: float) -> np.ndarray:
    """The pairs with so much left of the error of the hardest few."""
    better = pairs.copy()
    hardest = np.argsort(pairs[:, 0])[-count:]
    better[hardest, 0] = np.maximum(left * better[hardest, 0], 1.2e-5)
    return better


def rate(cases: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """Part of the cases in which the record is too good."""
    return float(np.mean([bool(too_good(judged(record, new, DRAWS))) for record, new in cases]))


def share(name: str, count: str, cases: list[tuple[np.ndarray, np.ndarray]]) -> str:
    """A line of the first table."""
    found = [[finding.name for finding in too_good(judged(record, new, DRAWS))]
             for record, new in cases]
    names = [finding.name for finding in judged(*cases[0], 1)]
    single = ", ".join(f"{100 * np.mean([name in each for each in found]):.1f}" for name in names)
    return f"| {name} | {count} | {100 * np.mean([bool(each) for each in found]):.1f} | {single} |"


def tails(populations: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Probabilities, if it were normal, of so small and so large a logarithm of each ratio."""
    low = []
    for pairs in populations:
        logarithms = np.log(pairs[:, 0] / pairs[:, 1])
        for i, own in enumerate(logarithms):
            others = np.delete(logarithms, i)
            scale = others.std(ddof=1) * np.sqrt(1.0 + 1.0 / len(others))
            low.append(student.cdf((own - others.mean()) / scale, len(others) - 1))
    return np.array(low), 1.0 - np.array(low)


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
