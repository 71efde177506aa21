"""The 2D pipe when the shape of the velocity profile is assumed wrongly, its mean rightly (cf.
thesis 5.1.2)."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed
from matplotlib.figure import Figure
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from eitbench.envs.estimation import EstimationEnv
from eitbench.physics.flow import PlaneChannelFlow, PlugFlow, PowerLawFlow
from eitbench.physics.transport import VelocityField
from eitbench.worlds.flows import PROFILES

from .common import ACCENT, INK, TRUE, bare, error_of, estimates_of, save, verdict

MEAN_VELOCITY = 4.5
"""m/s, true and assumed [T]"""
METHODS: dict[str, tuple[int | str, str, str]] = {
    "Kalman filter": (0, "kalman_filter", INK),
    "fixed-interval smoother": ("all", "fixed_interval_smoother", ACCENT)}
"""Lag, baseline and colour."""


def _env(lag: int | str, profile: str) -> EstimationEnv:
    known = {"flow": {"velocity_range": [MEAN_VELOCITY, MEAN_VELOCITY]}}
    return EstimationEnv("eitbench/Pipe2DBiasedVelocity-v0", world=known, lag=lag,
                         assume={"profile": profile})


def profiles(seeds: list[int], jobs: int, out: Path) -> tuple[Path, str]:
    """ẽ_c of filter and smoother by assumed profile, and the profiles."""
    errors = _errors(seeds, jobs)
    mean = {key: float(values.mean()) for key, values in errors.items()}
    figure = Figure(figsize=(10.4, 3.6), dpi=130, layout="constrained")
    left, right = figure.subplots(1, 2)
    R = _half_width()
    y = np.linspace(-R, R, 401)
    points = np.stack([np.zeros_like(y), y], axis=1)
    flows: tuple[VelocityField, ...] = (PlaneChannelFlow(MEAN_VELOCITY, R), PlugFlow(MEAN_VELOCITY),
                                        PowerLawFlow(MEAN_VELOCITY, R))
    for name, flow, style in zip(PROFILES, flows, ("-", "--", "-."), strict=True):
        left.plot(100 * y, flow(points)[:, 0], style, color=INK if name == "parabolic" else TRUE,
                  linewidth=1.6, label=name + " (true)" * (name == "parabolic"))
    left.set(xlabel="y / cm", ylabel="velocity / (m/s)", ylim=(0, None))
    left.legend(frameon=False, fontsize=9, loc="lower center")
    for k, (method, (_, _, colour)) in enumerate(METHODS.items()):
        for place, name in enumerate(PROFILES):
            values = errors[method, name]
            x = place + 0.2 * (k - 0.5)
            right.plot([x], [mean[method, name]], "o", color=colour, markersize=8,
                       label=method if not place else None)
            if len(seeds) > 1:
                right.plot(np.full(len(seeds), x), values, "_", color=colour, markersize=12)
            right.annotate(f"{mean[method, name]:.4f}", (x, mean[method, name]),
                           xytext=(10 * (2 * k - 1), 0),
                           textcoords="offset points", ha=("right", "left")[k], va="center",
                           fontsize=8)
    right.set(xticks=range(len(PROFILES)), xlim=(-0.6, len(PROFILES) - 0.4), ylim=(0, 1.15 * max(
        values.max() for values in errors.values())), ylabel="ẽ$_c$", xlabel="assumed profile")
    right.set_xticklabels(PROFILES)
    right.legend(frameon=False, fontsize=9, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    for ax in (left, right):
        bare(ax)
    path = out / "profiles.png"
    save(figure, path)
    constant = _error(0, "homogeneous", "parabolic", seeds).mean()
    wrong = [mean[method, name] for method, name in product(METHODS, PROFILES)
             if name != "parabolic"]
    return path, "\n".join([
        *(f"{method}: ẽ_c is " + ", ".join(f"{mean[method, name]:.4f} with the {name} profile"
                                           for name in PROFILES)
          + "." for method in METHODS),
        f"The homogeneous estimate has {constant:.4f}; mean of {len(seeds)} "
        f"episode{'s' * (len(seeds) > 1)}.",
        verdict("a wrong profile costs accuracy", all(
            mean[method, name] > mean[method, "parabolic"] for method in METHODS
            for name in PROFILES[1:])),
        verdict("yet all estimates are still of use: better than a constant",
                bool(max(wrong) < constant)),
        "By choice: which wrong profiles; their mean velocity is the true one."])


def _half_width() -> float:
    """R in m."""
    half_width: float = _env(0, PROFILES[0]).world.vessel.half_width
    return half_width


def _errors(seeds: list[int], jobs: int) -> dict[tuple[str, str], np.ndarray]:
    """ẽ_c (seeds,) by method and assumed profile."""
    cases = list(product(METHODS, PROFILES))
    with Parallel(n_jobs=jobs, return_as="generator", batch_size=1, pre_dispatch=jobs) as parallel:
        done = parallel(delayed(_error)(*METHODS[method][:2], name, seeds)
                        for method, name in cases)
        bar = tqdm(done, total=len(cases), desc="assumed profiles", unit="case", disable=None)
        return dict(zip(cases, bar, strict=True))


def _error(lag: int | str, baseline: str, profile: str, seeds: list[int]) -> np.ndarray:
    env = _env(lag, profile)
    with threadpool_limits(1):
        return np.array([error_of(env, estimates_of(env, baseline, seed)) for seed in seeds])
