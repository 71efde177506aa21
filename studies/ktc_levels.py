"""Scores of the Kuopio Tomography Challenge 2023 by level: `python studies/ktc_levels.py FOLDER`.

FOLDER holds level1 to level7, each with ref.mat, data1.mat to data3.mat, and the ground truths
true1.mat to true3.mat. Each level removes two electrodes more, with all measurements that use them.
Prints the score of each tank, sum of each level and total; ten minutes.
"""

import sys
from pathlib import Path

from eitbench.bench.runner import run_on_measurements
from eitbench.envs.measured import MeasuredEnv
from eitbench.measured.cases import read_case
from eitbench.measured.segmentation import ktc_score, read_truth, segment

LEVELS = range(1, 8)
TANKS = range(1, 4)
METHODS = ("log_map", "map_estimate")


def main(folder: Path) -> None:
    vessel = dict(read_case("ktc-1").vessel)
    totals = dict.fromkeys(METHODS, 0.0)
    for level in LEVELS:
        scores: dict[str, list[float]] = {name: [] for name in METHODS}
        for tank in TANKS:
            files = folder / f"level{level}"
            env = MeasuredEnv(files / f"data{tank}.mat", vessel, withheld=0.0)
            truth = read_truth(files / f"true{tank}.mat")
            for name in METHODS:
                run = run_on_measurements(env, name)
                scores[name].append(ktc_score(truth, segment(env.vessel, env.task, run.mean[-1])))
        for name, each in scores.items():
            totals[name] += sum(each)
            print(f"level {level}, {name}: {', '.join(f'{score:.2f}' for score in each)}, "
                  f"sum {sum(each):.2f}, total so far {totals[name]:.2f}", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
