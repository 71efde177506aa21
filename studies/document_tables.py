"""Tables of the environments and of the built-in estimators in docs/.

`python studies/document_tables.py` writes them into docs/environments.md, docs/estimators.md,
docs/methods.md and docs/pipe2d.md, from the registered environments and
leaderboards/leaderboard.csv, in half a minute.
"""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd

from eitbench.bench.scores import scores
from eitbench.bench.table import Table, number_cell
from eitbench.bench.tracks import builtin_ids, subtrack_of
from eitbench.envs.episodes import EpisodeEnv
from eitbench.physics.stationary import StationaryTransport

ROOT = Path(__file__).resolve().parent.parent
COLUMNS = {
    "Pipe2D": "2D", "Pipe2DFixedLag": "lag 4", "Pipe2DSmoothing": "smoothing",
    "Pipe2DBiasedVelocity": "biased", "Pipe2DObstacle": "obstacle",
    "Pipe2DUnknownVelocity": "unknown velocity", "Pipe2DIntermittent": "intermittent",
    "Pipe3D": "3D", "Pipe3DSmoothing": "3D smoothing", "RotatingTank2D": "rotating",
    "StationaryTank2D": "stationary", "WanderingBody2D": "body"}
"""Environment -> column of the table of estimators."""
WITHOUT_FLOW = {"back_projection": "BP", "noser": "NOSER", "total_variation": "TV",
                "gauss_newton": "GN", "random_walk_filter": "walk",
                "temporal_regularisation": "temporal"}
"""Method without a flow model -> column of its table."""
PLANT_SCORES = ("error", "solute_flow_error", "solute_flow_coverage_90", "solute_amount_error",
                "section_error", "energy_score", "arrival_error", "duration_error")
THESIS = ("kalman_filter", "fixed_lag_smoother", "fixed_interval_smoother")
ASSUMPTIONS = {
    "homogeneous": ("–", "one constant"),
    "persistence": ("at rest for a frame", "smooth"),
    "back_projection": ("at rest for a frame", "–"),
    "noser": ("at rest for a frame", "independent nodes"),
    "gauss_newton": ("at rest for a frame", "smooth"),
    "total_variation": ("at rest for a frame", "sharp edges"),
    "temporal_regularisation": ("correlated in time", "smooth"),
    "random_walk_filter": ("random walk", "smooth"),
    "map_estimate": ("at rest", "smooth"),
    "log_map": ("at rest", "smooth, positive"),
    "log_walk_filter": ("random walk", "smooth, positive"),
    "log_steady_filter": ("random walk with a rate", "smooth, positive"),
    "kalman_filter": ("as in the task", "white inflow"),
    "extended_kalman_filter": ("as in the task", "white inflow"),
    "adaptive_inflow_filter": ("as in the task", "white, variance estimated"),
    "fixed_lag_smoother": ("as in the task", "white inflow"),
    "fixed_interval_smoother": ("as in the task", "white inflow"),
    "approximation_error_filter": ("as in the task, with its error", "fitted inflow"),
    "turbulent_filter": ("as in the task, and eddies", "fitted inflow, positive"),
    "coloured_extended_kalman_filter": ("as in the task", "fitted inflow"),
    "log_inflow_filter": ("as in the task", "fitted inflow, positive"),
    "inflow_smoother": ("as in the task", "fitted inflow, positive"),
    "ensemble_smoother": ("as in the task", "fitted inflow, positive"),
    "fast_inflow_filter": ("as in the task", "fitted inflow, positive"),
    "unscented_filter": ("as in the task", "fitted inflow, positive"),
    "switching_inflow_filter": ("as in the task", "two regimes, positive"),
    "particle_filter": ("as in the task", "two regimes, positive"),
    "identified_flow": ("identified from episodes", "fitted inflow, positive"),
    "real_time_filter": ("identified from episodes", "fitted inflow, positive"),
    "filter_bank": ("one of nine velocities", "white inflow"),
    "cross_correlation": ("velocity by cross-correlation", "white inflow"),
    "joint_extended_kalman_filter": ("estimated parameters", "white inflow"),
    "joint_inflow_filter": ("estimated parameters", "fitted inflow, positive"),
    "ensemble_kalman_filter": ("estimated parameters", "fitted inflow, positive"),
    "body_particle_filter": ("none", "one disc"),
    "automatic_filter": ("chosen by the task", "chosen by the task"),
    "learned_voltages": ("none", "network"),
    "learned_correction": ("as in the task", "fitted inflow, network"),
    "learned_fixed_lag": ("as in the task", "fitted inflow, network"),
    "learned_smoother": ("as in the task", "fitted inflow, network"),
    "learned_obstacle": ("identified from episodes", "fitted inflow, network"),
    "true_model_smoother": ("true (oracle)", "fitted inflow, positive")}
"""Built-in estimator -> assumed flow, and assumed inflow or image."""


def base_name(id: str) -> str:
    """Return an id without namespace and version."""
    return id.removeprefix("eitbench/").removesuffix("-v0")


def environments() -> str:
    """Return the table of all built-in environments."""
    rows = []
    for id in builtin_ids():
        env = gym.make(id).unwrapped
        task = env.task
        rows.append({
            "id": base_name(id), "subtrack": subtrack_of(env),
            "nodes": number_cell(task.mesh.n_nodes),
            "states (scored)": f"{task.n_steps} ({task.n_steps - task.warm_up})",
            "velocity": velocity(env), "observation": space(env.observation_space),
            "action": space(env.action_space)})
    return Table.of(rows).markdown()


def velocity(env: EpisodeEnv) -> str:
    """Return how the velocity in the task compares with the true one."""
    task, flow = env.task, env.world.flow
    if isinstance(task.transport, StationaryTransport):
        return "at rest"
    if task.velocity is not None:
        return f"unknown ({task.velocity.n_parameters})"
    drawn = flow.draw(env.world, np.random.default_rng(0))
    true = flow.nominal(env.world, False) if drawn is None else drawn(1)
    points = task.mesh.points
    return "true" if np.allclose(true(points), task.transport.velocity(points)) else "wrong"


def space(of: gym.Space) -> str:
    """Return a short text of a space."""
    if isinstance(of, gym.spaces.Dict):
        return " + ".join(str(each.shape[0]) for each in of.values()) + " numbers"
    if isinstance(of, gym.spaces.Discrete):
        return f"{of.n} choices"
    return f"{np.prod(of.shape)} numbers"


def leaderboard() -> pd.DataFrame:
    """Return the rows of leaderboard.csv, with the base names of environments."""
    scores = pd.read_csv(ROOT / "leaderboards" / "leaderboard.csv")
    scores = scores[scores["environment"] != "all"]
    return scores.assign(environment=scores["environment"].map(base_name))


def estimators() -> str:
    """Return the table of all built-in estimators: assumptions, cost and errors."""
    table = leaderboard()
    rows = []
    for method, (flow, inflow) in ASSUMPTIONS.items():
        own = table[table["method"] == method].set_index("environment").reindex(COLUMNS)
        seconds = own["seconds_per_step"].dropna()
        rows.append({
            "method": method, "flow": flow, "inflow or image": inflow,
            "ms/step": number_cell(1e3 * seconds.iloc[0] if len(seconds) else None)} | {
            COLUMNS[id]: number_cell(1e4 * error) for id, error in own["error"].items()})
    return Table.of(rows).markdown()


def methods() -> str:
    """Return the table of the errors without a flow model, with the thesis' and the best one."""
    table = leaderboard()
    rows = []
    estimated = table.loc[~table["class"].isin(("injection", "measured")), "environment"]
    for id in (name for name in map(base_name, builtin_ids()) if name in set(estimated)):
        own = table[table["environment"] == id].set_index("method")
        best = own.loc[own["rank"].notna(), "error"].idxmin()
        errors = {column: own["error"].get(name, np.nan)
                  for name, column in WITHOUT_FLOW.items()}
        errors |= {"thesis": own["error"].reindex(THESIS).dropna().iloc[0],
                   "best": own["error"][best]}
        rows.append({"environment": id, **{name: number_cell(1e4 * error)
                                           for name, error in errors.items()}, "best method": best})
    return Table.of(rows).markdown()


def plant(*ids: str) -> str:
    """Return the table of the scores of flows and slugs in environments, by the flow's error."""
    shown = [scores()[name] for name in PLANT_SCORES]
    by = "solute_flow_error"
    found = leaderboard().dropna(subset=by).sort_values([by, "method"])
    rows = [{"environment": id, "method": row["method"]} | {
                score.heading: number_cell(score.factor * row[score.name]) for score in shown}
            for id in ids for _, row in found[found["environment"] == id].iterrows()]
    return Table.of(rows).markdown()


def main() -> None:
    """Write the tables between their markers."""
    for name, made in (("environments", environments()), ("estimators", estimators()),
                       ("methods", methods()), ("pipe2d", plant("Pipe2D", "Pipe2DSmoothing")),
                       ("velocity", plant("Pipe2DUnknownVelocity")),
                       ("turbulence", plant("Pipe2DTurbulent"))):
        path = ROOT / "docs" / f"{name}.md"
        before, rest = path.read_text(encoding="utf-8").split("<!-- table -->\n")
        after = rest.partition("\n<!-- end -->")[2]
        path.write_text(f"{before}<!-- table -->\n{made}\n<!-- end -->{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
