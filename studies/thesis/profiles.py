"""2D pipe with a wrong velocity profile of the right mean in the model (cf. thesis 5.1.2)."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from threadpoolctl import threadpool_limits

from eitbench.envs.estimation import EstimationEnv
from eitbench.physics.flow import PlaneChannelFlow, PowerLawFlow
from eitbench.physics.transport import VelocityField
from eitbench.worlds.flows import PROFILES

from .common import (
    ACCENT,
    GREY,
    INK,
    agreement_line,
    despine,
    episode_error,
    run_baseline,
    run_parallel,
    save_figure,
)

MEAN_VELOCITY = 4.5
"""m/s, true and assumed [T]"""
METHODS: dict[str, tuple[int | str, str, str]] = {
    "Kalman filter": (0, "kalman_filter", INK),
    "fixed-interval smoother": ("all", "fixed_interval_smoother", ACCENT)}
"""Name -> lag, baseline and colour."""


def _env(lag: int | str, profile: str) -> EstimationEnv:
    fixed = {"flow": {"velocity_range": [MEAN_VELOCITY, MEAN_VELOCITY]}}
    return EstimationEnv("eitbench/Pipe2DBiasedVelocity-v0", world=fixed, lag=lag,
                         assume={"profile": profile})


def profiles(seeds: list[int], jobs: int, out: Path) -> tuple[Path, str]:
    """Draw the profiles, and ẽ_c of filter and smoother for each assumed profile."""
    errors = _errors(seeds, jobs)
    mean = {key: float(values.mean()) for key, values in errors.items()}
    figure = Figure(figsize=(10.4, 3.6), dpi=130, layout="constrained")
    left, right = figure.subplots(1, 2)
    R = _half_width()
    y = np.linspace(-R, R, 401)
    points = np.stack([np.zeros_like(y), y], axis=1)
    flows: tuple[VelocityField, ...] = (PlaneChannelFlow(MEAN_VELOCITY, R),
                                        PowerLawFlow(MEAN_VELOCITY, R, exponent=0.0),
                                        PowerLawFlow(MEAN_VELOCITY, R))
    for name, flow, style in zip(PROFILES, flows, ("-", "--", "-."), strict=True):
        left.plot(100 * y, flow(points)[:, 0], style, color=INK if name == "parabolic" else GREY,
                  linewidth=1.6, label=name + " (true)" * (name == "parabolic"))
    left.set(xlabel="y / cm", ylabel="velocity / (m/s)", ylim=(0, None))
    left.legend(frameon=False, fontsize=9, loc="lower center")
    for k, (method, (_, _, colour)) in enumerate(METHODS.items()):
        for position, name in enumerate(PROFILES):
            values = errors[method, name]
            x = position + 0.2 * (k - 0.5)
            right.plot([x], [mean[method, name]], "o", color=colour, markersize=8,
                       label=method if not position else None)
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
        despine(ax)
    path = out / "profiles.png"
    save_figure(figure, path)
    constant = _error(0, "homogeneous", "parabolic", seeds).mean()
    wrong = [mean[method, name] for method, name in product(METHODS, PROFILES)
             if name != "parabolic"]
    return path, "\n".join([
        *(f"{method}: ẽ_c is " + ", ".join(f"{mean[method, name]:.4f} with the {name} profile"
                                           for name in PROFILES)
          + "." for method in METHODS),
        f"The homogeneous estimate has {constant:.4f}; mean of {len(seeds)} "
        f"episode{'s' * (len(seeds) > 1)}.",
        agreement_line("a wrong profile costs accuracy", all(
            mean[method, name] > mean[method, "parabolic"] for method in METHODS
            for name in PROFILES[1:])),
        agreement_line("all estimates are still better than a constant",
                       bool(max(wrong) < constant)),
        "Not from the thesis: the choice of the profiles, which have the true mean velocity."])


def _half_width() -> float:
    """Return R in m."""
    half_width: float = _env(0, PROFILES[0]).world.vessel.half_width
    return half_width


def _errors(seeds: list[int], jobs: int) -> dict[tuple[str, str], np.ndarray]:
    """Return ẽ_c (seeds,) for each method and assumed profile."""
    cases = list(product(METHODS, PROFILES))
    errors = run_parallel(_error, [(*METHODS[method][:2], name, seeds) for method, name in cases],
                          jobs, "assumed profiles")
    return dict(zip(cases, errors, strict=True))


def _error(lag: int | str, baseline: str, profile: str, seeds: list[int]) -> np.ndarray:
    env = _env(lag, profile)
    with threadpool_limits(1):
        return np.array([episode_error(env, run_baseline(env, baseline, seed)) for seed in seeds])
