"""Tables of the environments and of the built-in estimators in docs/.

`python studies/document_tables.py` writes them into docs/environments.md and docs/estimators.md,
from the registered environments and leaderboards/leaderboard.csv, in half a minute.
"""

import csv
import re
from pathlib import Path

import gymnasium as gym
import numpy as np

import eitbench  # noqa: F401 (registers the environments)
from eitbench.bench.tracks import builtin_ids, subtrack_of
from eitbench.physics.stationary import StationaryTransport

ROOT = Path(__file__).resolve().parent.parent
WRONG_VELOCITY = ("BiasedVelocity", "OtherVelocity", "Obstacle")
"""Environments whose task has another velocity than the truth."""
COLUMNS = {
    "Pipe2D": "2D", "Pipe2DFixedLag": "lag 4", "Pipe2DSmoothing": "smoothing",
    "Pipe2DBiasedVelocity": "biased", "Pipe2DObstacle": "obstacle",
    "Pipe2DUnknownVelocity": "unknown velocity", "Pipe2DIntermittent": "intermittent",
    "Pipe3D": "3D", "Pipe3DSmoothing": "3D smoothing", "RotatingTank2D": "rotating",
    "StationaryTank2D": "stationary"}
"""Environment -> column of the table of estimators."""
ASSUMPTIONS = {
    "homogeneous": ("–", "one constant"),
    "persistence": ("at rest for a frame", "smooth"),
    "gauss_newton": ("at rest for a frame", "smooth"),
    "map_estimate": ("at rest", "smooth"),
    "log_map": ("at rest", "smooth, positive"),
    "log_walk_filter": ("random walk", "smooth, positive"),
    "log_steady_filter": ("random walk with a rate", "smooth, positive"),
    "kalman_filter": ("as in the task", "white inflow"),
    "extended_kalman_filter": ("as in the task", "white inflow"),
    "fixed_lag_smoother": ("as in the task", "white inflow"),
    "fixed_interval_smoother": ("as in the task", "white inflow"),
    "approximation_error_filter": ("as in the task, with its error", "fitted inflow"),
    "coloured_extended_kalman_filter": ("as in the task", "fitted inflow"),
    "log_inflow_filter": ("as in the task", "fitted inflow, positive"),
    "inflow_smoother": ("as in the task", "fitted inflow, positive"),
    "fast_inflow_filter": ("as in the task", "fitted inflow, positive"),
    "unscented_filter": ("as in the task", "fitted inflow, positive"),
    "switching_inflow_filter": ("as in the task", "two regimes, positive"),
    "particle_filter": ("as in the task", "two regimes, positive"),
    "identified_flow": ("identified from episodes", "fitted inflow, positive"),
    "real_time_filter": ("identified from episodes", "fitted inflow, positive"),
    "filter_bank": ("one of nine velocities", "white inflow"),
    "joint_extended_kalman_filter": ("estimated parameters", "white inflow"),
    "joint_inflow_filter": ("estimated parameters", "fitted inflow, positive"),
    "ensemble_kalman_filter": ("estimated parameters", "fitted inflow, positive"),
    "automatic_filter": ("chosen by the task", "chosen by the task"),
    "learned_voltages": ("none", "network"),
    "learned_correction": ("as in the task", "fitted inflow, network"),
    "learned_fixed_lag": ("as in the task", "fitted inflow, network"),
    "learned_smoother": ("as in the task", "fitted inflow, network"),
    "learned_obstacle": ("identified from episodes", "fitted inflow, network"),
    "true_model_smoother": ("true (oracle)", "fitted inflow, positive")}
"""Built-in estimator -> assumed flow, and assumed inflow or image."""


def short(id: str) -> str:
    """Return an id without namespace and version."""
    return id.partition("/")[2].removesuffix("-v0")


def table(rows: list[list[str]]) -> str:
    """Return a Markdown table; the first row is the header."""
    lines = [rows[0], ["---"] * len(rows[0]), *rows[1:]]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def number(x: float) -> str:
    """Return a number with three digits, without an exponent."""
    return f"{float(f'{x:.3g}'):g}"


def environments() -> str:
    """Return the table of all built-in environments."""
    rows = [["id", "subtrack", "nodes", "states (scored)", "velocity", "observation",
             "action"]]
    for id in builtin_ids():
        env = gym.make(id).unwrapped
        task, name = env.task, short(id)
        flow = ("at rest" if isinstance(task.transport, StationaryTransport) else
                f"unknown ({len(task.velocity.nominal)})" if task.velocity else
                "wrong" if name.endswith(WRONG_VELOCITY) else "true")
        rows.append([
            f"`{name}`", subtrack_of(env), f"{task.mesh.n_nodes:,}",
            f"{task.n_steps} ({task.n_steps - task.warm_up})", flow,
            space(env.observation_space), space(env.action_space)])
    return table(rows)


def space(of: gym.Space) -> str:
    """Return a short text of a space."""
    if isinstance(of, gym.spaces.Dict):
        return " + ".join(str(each.shape[0]) for each in of.values()) + " numbers"
    if isinstance(of, gym.spaces.Discrete):
        return f"{of.n} choices"
    return f"{np.prod(of.shape):,} numbers"


def scores() -> list[dict[str, str]]:
    """Return the rows of the leaderboards."""
    with open(ROOT / "leaderboards" / "leaderboard.csv", encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def estimators() -> str:
    """Return the table of all built-in estimators: assumptions, cost and errors."""
    rows = {(row["method"], short(row["environment"])): row for row in scores()
            if row["environment"] != "all"}
    lines = [["method", "flow", "inflow or image", "ms/step", *COLUMNS.values()]]
    for method, assumptions in ASSUMPTIONS.items():
        own = [rows.get((method, id)) for id in COLUMNS]
        times = [number(1e3 * float(row["seconds_per_step"])) for row in own if row]
        lines.append([f"`{method}`", *assumptions, *(times[:1] or [""]),
                      *(number(1e4 * float(row["error"])) if row else "" for row in own)])
    return table(lines)


def main() -> None:
    """Write both tables between their markers."""
    for name, made in (("environments", environments()), ("estimators", estimators())):
        path = ROOT / "docs" / f"{name}.md"
        text, n = re.subn(r"(<!-- table -->\n).*?(\n<!-- end -->)",
                          lambda found, made=made: found[1] + made + found[2],
                          path.read_text(encoding="utf-8"), flags=re.DOTALL)
        assert n == 1, path
        path.write_text(text, encoding="utf-8")
        print("wrote", path)


if __name__ == "__main__":
    main()
