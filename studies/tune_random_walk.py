"""Choose the constants of methods without a flow model, and of the adaptive filter: `python
studies/tune_random_walk.py [METHOD …]`.

The rule: the smallest mean error on a grid, in filtering in the 2D pipe on train:0-1. It takes 15
to 20 minutes. Dev and test episodes are not used.
"""

import sys
from itertools import product
from pathlib import Path

import eitbench
from eitbench.bench.methods import load_module

SEEDS = "train:0-1"
BASELINES = Path(__file__).resolve().parent.parent / "baselines"
GRIDS: dict[str, dict[str, tuple[float, ...]]] = {
    "random_walk_filter": {"LENGTH": (0.04, 0.056, 0.08, 0.113, 0.16),
                           "STEP": (0.0025, 0.005, 0.01, 0.02)},
    "temporal_regularisation": {"LENGTH": (0.007, 0.01, 0.014, 0.02), "STD": (0.05, 0.1, 0.2),
                                "GAMMA": (0.6, 0.7, 0.8, 0.9)},
    "adaptive_inflow_filter": {"RATE": (0.01, 0.02, 0.03, 0.05, 0.1)}}
"""Method -> constant -> its values."""


def main() -> None:
    for name, grid in GRIDS.items():
        if len(sys.argv) > 1 and name not in sys.argv:
            continue
        path = BASELINES / f"{name}.py"
        module = load_module("method", path, path.read_bytes())
        errors = {}
        for values in product(*grid.values()):
            vars(module).update(zip(grid, values, strict=True))
            table = eitbench.evaluate(module.Estimator, "eitbench/Pipe2D-v0", SEEDS)
            errors[values] = table["error"].mean()
            print(name, dict(zip(grid, values, strict=True)), f"{errors[values]:.5f}", flush=True)
        print("best:", name, dict(zip(grid, min(errors, key=errors.__getitem__), strict=True)))


if __name__ == "__main__":
    main()
