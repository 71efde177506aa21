"""Error of the full minus the reduced filter: `python studies/reduced_filter.py`, some minutes once
the episodes are simulated.

Policies run on the episodes of their official records with the reduced filter. The table has the
mean difference of the errors on the same episodes with its 95 % interval.
"""

from __future__ import annotations

import json

from tqdm import tqdm

from eitbench._files import bundled_path
from eitbench.bench.records import read_records
from eitbench.bench.run import Job, run_episode
from eitbench.bench.text import format_mean, mean_and_interval, scores_by_seed
from eitbench.bench.tracks import Environment
from eitbench.bench.verify import job_for_record
from eitbench.data.seeds import parse_seeds, seed_ranges

POLICIES = {"Pipe2DInjection": ("best_pair", "random_pair"),
          "Pipe2DInjectionFaults": ("fault_aware", "ppo_seed0", "schedule"),
          "Pipe2DInjectionBudget": ("schedule", "event_triggered", "maskable_ppo_seed0"),
          "Pipe2DInjectionFlow": ("random_pair", "ppo_seed0"),
          "RotatingTankInjection": ("best_pair", "random_pair")}


def main() -> None:
    records = {(record["environment"]["name"], record["method"]): record
               for record in read_records(bundled_path("leaderboards") / "results")}
    print("| environment | episodes | policy | full | full − reduced "
          "|\n|---|---|---|---:|---:|")
    for world, policies in POLICIES.items():
        for policy in policies:
            record = records[f"eitbench-{world}-v0", policy]
            full_errors = scores_by_seed(record, "error")
            job = job_for_record(record, isolate="none")
            reduced = Environment(job.environment.id, json.dumps({"estimator": "reduced"}))
            differences = [
                full_errors[seed] - run_episode(Job(reduced, job.method, parse_seeds(seed)[0])
                                                )[0]["scores"]["error"]
                for seed in tqdm(full_errors, desc=f"{world}, {policy}", leave=False, disable=None)]
            error, _ = mean_and_interval(list(full_errors.values()))
            print(f"| {world} | {seed_ranges(list(full_errors))} | {policy} | {error:.4f} | "
                  f"{format_mean(*mean_and_interval(differences))} |", flush=True)


if __name__ == "__main__":
    main()
