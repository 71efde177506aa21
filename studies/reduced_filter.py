"""What the reduced filter costs: `python studies/reduced_filter.py`, some minutes once the episodes
are simulated.

Policies play the episodes of their official records once more, with the reduced filter inside;
printed is by how much the exact one's error is larger in the same episodes, with its 95 % interval.
"""

from __future__ import annotations

import json

from tqdm import tqdm

from eitbench._files import shipped
from eitbench.bench.records import read_records
from eitbench.bench.run import Job, run_episode
from eitbench.bench.text import mean_and_interval, rounded, scores_by_seed, seed_ranges
from eitbench.bench.tracks import Environment
from eitbench.bench.verify import job_for_record
from eitbench.data.seeds import parse_seeds

PLAYED = {"Pipe2DInjection": ("best_pair", "random_pair"),
          "Pipe2DInjectionFaults": ("fault_aware", "ppo_seed0", "schedule"),
          "Pipe2DInjectionBudget": ("schedule", "event_triggered", "maskable_ppo_seed0"),
          "Pipe2DInjectionFlow": ("random_pair", "ppo_seed0"),
          "RotatingTankInjection": ("best_pair", "random_pair")}


def main() -> None:
    records = {(record["environment"]["name"], record["method"]): record
               for record in read_records(shipped("leaderboards") / "results")}
    print("| environment | episodes | policy | exact | exact less reduced "
          "|\n|---|---|---|---:|---:|")
    for world, policies in PLAYED.items():
        for policy in policies:
            record = records[f"eitbench-{world}-v0", policy]
            exact = scores_by_seed(record, "error")
            full = job_for_record(record, isolate="none")
            reduced = Environment(full.environment.id, json.dumps({"estimator": "reduced"}))
            steps = [exact[seed]
                     - run_episode(Job(reduced, full.method,
                                       parse_seeds(seed)[0]))[0]["scores"]["error"]
                     for seed in tqdm(exact, desc=f"{world}, {policy}", leave=False, disable=None)]
            error, _ = mean_and_interval(list(exact.values()))
            print(f"| {world} | {seed_ranges(list(exact))} | {policy} | {error:.4f} | "
                  f"{rounded(*mean_and_interval(steps))} |", flush=True)


if __name__ == "__main__":
    main()
