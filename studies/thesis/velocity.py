"""Figures 6.1 to 6.6 of the thesis: joint estimation of concentration and velocity."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.interpolate import CubicSpline

from eitbench import scoring
from eitbench.envs.estimation import EstimationEnv
from eitbench.physics.profiles import VelocityModel
from eitbench.worlds.task import Estimate

from .common import (
    ACCENT,
    GREY,
    INK,
    agreement_line,
    despine,
    draw_fields,
    episode_error,
    format_milliseconds,
    run_baseline,
    save_figure,
    snapshot_times,
)

METHOD = "joint_extended_kalman_filter"


class VelocityRun(NamedTuple):
    """Run of the joint filter on an episode, with simpler methods for comparison."""

    env: EstimationEnv
    estimates: list[Estimate]
    error: float
    """ẽ_c"""
    fallbacks: dict[str, float]
    """ẽ_c of simpler methods on the same episode"""

    @property
    def model(self) -> VelocityModel:
        """Parametrisation of the velocity."""
        model = self.env.task.velocity
        assert model is not None
        return model

    @property
    def parameters(self) -> np.ndarray:
        """(T, k) estimated θ in m/s; prior mean before the first estimate."""
        return np.array([self.model.nominal if each.velocity is None else each.velocity
                         for each in self.estimates])

    @property
    def deviations(self) -> np.ndarray:
        """(T, k) standard deviations of `parameters`, m/s."""
        return np.sqrt([np.square(self.model.initial_std) if each.velocity_variance is None
                        else each.velocity_variance
                        for each in self.estimates])

    @property
    def profiles(self) -> np.ndarray:
        """(T, p) estimated velocity in m/s at the model's points."""
        return self.parameters @ self.model.profiles.T

    def mean(self, profiles: np.ndarray) -> np.ndarray:
        """Return the mean over the width of the pipe of velocities (..., p)."""
        return profiles @ self.model.weights / self.model.weights.sum()

    def times(self) -> np.ndarray:
        """Return the times (T,) in ms."""
        return 1e3 * self.env.task.transport.time_step * np.arange(1, len(self.estimates) + 1)


def _env(flow: str) -> EstimationEnv:
    """Return the pipe with a flow that is "unknown", "time-varying" or "skewed"."""
    kind = {"unknown": "Unknown", "time-varying": "TimeVarying", "skewed": "Skewed"}[flow]
    return EstimationEnv(f"eitbench/Pipe2D{kind}Velocity-v0")


@lru_cache(maxsize=3)
def run_joint_filter(flow: str, seed: int) -> VelocityRun:
    """Run the joint filter once for all figures that show the episode."""
    env = _env(flow)
    fallbacks = {name: episode_error(env, run_baseline(env, name, seed))
                 for name in ("kalman_filter", "filter_bank")}
    estimates = run_baseline(env, METHOD, seed)
    return VelocityRun(env, estimates, episode_error(env, estimates), fallbacks)


def _error_comparison(run: VelocityRun) -> str:
    fallbacks = run.fallbacks
    return (f"ẽ_c is {run.error:.4f}; {fallbacks['kalman_filter']:.4f} for the Kalman filter that "
            f"assumes {run.model.nominal[0]:g} m/s, {fallbacks['filter_bank']:.4f} for a bank of "
            "nine filters.")


# -- pictures --------------------------------------------------------------------------------------


def fig6_1(seeds: list[int], _jobs: int, out: Path) -> tuple[Path, str]:
    """Draw concentration and velocity, true and estimated, for a parabolic flow."""
    return _states(run_joint_filter("unknown", seeds[0]), out / "fig6.1.png")


def fig6_6(seeds: list[int], _jobs: int, out: Path) -> tuple[Path, str]:
    """Draw concentration and velocity, true and estimated, for an asymmetric flow."""
    return _states(run_joint_filter("skewed", seeds[0]), out / "fig6.6.png")


def _states(run: VelocityRun, path: Path) -> tuple[Path, str]:
    env = run.env
    times = snapshot_times(env)
    figure = Figure(figsize=(10.4, 0.98 * len(times) + 0.8), dpi=130, layout="constrained")
    axes = figure.subplots(len(times), 3, sharey=True, width_ratios=(1, 1, 0.42))
    mappable = draw_fields(env, axes[:, :2], times, [run.estimates])
    true, estimated = env.true_velocity(), run.profiles
    for ax, t in zip(axes[:, 2], times, strict=True):
        _profiles(ax, run.model, {"truth": true[t - 1], "estimate": estimated[t - 1]},
                  vertical=True)
        ax.set(xlim=(0, 1.1 * max(true.max(), estimated[times[0] - 1:].max())), ylim=_heights(env))
        ax.label_outer(remove_inner_ticks=True)
    for ax, title in zip(axes[0], ("truth", "extended Kalman filter", "velocity: truth dotted"),
                         strict=True):
        ax.set_title(title, fontsize=10)
    for ax in axes[:-1, :2].flat:
        ax.tick_params(labelbottom=False)
    for ax, label in zip(axes[-1], ("x / cm", "x / cm", "velocity / (m/s)"), strict=True):
        ax.set_xlabel(label)
    figure.colorbar(mappable, ax=axes[:, 2], label="concentration / (mol/m³)", extend="both",
                    aspect=40, pad=0.08)
    save_figure(figure, path)
    velocity_error = _velocity_error(run, slice(env.task.warm_up, None))
    return path, "\n".join([
        f"{_error_comparison(run)} ẽ_v, squared like ẽ_c, is {velocity_error:.5f}.",
        agreement_line("estimating the velocity reduces ẽ_c below that with the prior velocity",
                       run.error < run.fallbacks["kalman_filter"]),
        agreement_line("the estimated velocity is within 15 % of the true one (ẽ_v < 0.0225)",
                       velocity_error < 0.15**2),
        "Not from the thesis: inflow, electrodes, injections and the sampled flow."])


def _heights(env: EstimationEnv) -> tuple[float, float]:
    """Return the lowest and the highest point of the pipe in cm."""
    y = 100 * env.task.mesh.points[:, 1]
    return float(y.min()), float(y.max())


def _velocity_error(run: VelocityRun, steps: slice) -> float:
    """Return ẽ_v: ∫(v̂ − v)² / ∫v² across the pipe, averaged over the steps."""
    return scoring.relative_error(run.profiles[steps], run.env.true_velocity()[steps],
                                  np.diag(run.model.weights))


def _profiles(ax: Axes, model: VelocityModel, curves: dict[str, np.ndarray], *,
              vertical: bool) -> None:
    """Draw profiles (m/s), zero on the walls; the vertical axis is the height if ``vertical``."""
    R = model.half_width
    y = 100 * np.linspace(-R, R, 101)
    for label, profile in curves.items():
        v = CubicSpline(100 * np.concatenate([[-R], model.points, [R]]), np.pad(profile, 1))(y)
        colour, line = (GREY, ":") if label == "truth" else (INK, "-")
        ax.plot(*((v, y) if vertical else (y, v)), linewidth=1.6, label=label, color=colour,
                linestyle=line)


# -- curves ----------------------------------------------------------------------------------------


def fig6_2(seeds: list[int], _jobs: int, out: Path) -> tuple[Path, str]:
    """Draw the mean velocity of a parabolic flow over time, and the profile at the final step."""
    run = run_joint_filter("unknown", seeds[0])
    path = out / "fig6.2.png"
    _over_time(run, path)
    true, mean = run.mean(run.env.true_velocity()), run.mean(run.profiles)
    warm_up = run.env.task.warm_up
    deviation = run.deviations[:, 0]
    error = np.abs(mean - true)[warm_up:]
    return path, "\n".join([
        f"The true mean velocity is {true[-1]:.2f} m/s, the last estimate {mean[-1]:.2f} ± "
        f"{deviation[-1]:.2f}. After the warm-up the largest error is "
        f"{100 * (error / true[warm_up:]).max():.1f} %; the truth is within one standard deviation "
        f"{100 * np.mean(error < deviation[warm_up:]):.0f} % of the time. "
        f"{_error_comparison(run)}",
        agreement_line("after the warm-up the mean velocity is within 10 % of the truth",
                       bool((error < 0.1 * true[warm_up:]).all())),
        "Not from the thesis: the prior, 4.5 ± 1 m/s, and the random walk."])


def fig6_3(seeds: list[int], _jobs: int, out: Path) -> tuple[Path, str]:
    """Draw a time-varying mean velocity of a parabolic flow, and the profile at the final step."""
    run = run_joint_filter("time-varying", seeds[0])
    path = out / "fig6.3.png"
    _over_time(run, path)
    warm_up = run.env.task.warm_up
    true, mean = (run.mean(each)[warm_up:]
                  for each in (run.env.true_velocity(), run.profiles))
    rms, constant = np.sqrt(np.mean((mean - true)**2)), true.std()
    lag, correlation = estimate_delay(mean, true)
    return path, "\n".join([
        f"The mean velocity varies from {true.min():.2f} to {true.max():.2f} m/s; the RMS error of "
        f"the estimate is {rms:.2f} m/s, of the best constant {constant:.2f}. The delay is {lag} "
        f"injections (correlation {correlation:.2f}). {_error_comparison(run)}",
        agreement_line("the estimate follows the changing velocity: closer than any constant",
                       bool(rms < constant)),
        agreement_line("the estimate has a delay of one injection or more", lag >= 1),
        "Not from the thesis: amplitude and period of the variation; the model has a random walk."])


def estimate_delay(estimate: np.ndarray, truth: np.ndarray,
                   max_delay: int = 20) -> tuple[int, float]:
    """Return the delay (steps ≥ 0) of ``estimate`` with the largest correlation to ``truth``, and
    that correlation."""
    max_delay = min(max_delay, len(truth) // 3)
    correlations = [np.corrcoef(estimate[lag:], truth[:len(truth) - lag])[0, 1]
                    for lag in range(max_delay + 1)]
    best = int(np.argmax(correlations))
    return best, float(correlations[best])


def _over_time(run: VelocityRun, path: Path) -> None:
    times = run.times()
    warm_up = run.env.task.warm_up
    true, mean, deviation = (run.mean(run.env.true_velocity()), run.mean(run.profiles),
                             run.deviations[:, 0])       # the one parameter is the mean velocity
    figure = Figure(figsize=(10.4, 3.4), dpi=130, layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.6, 1))
    left.axvspan(0, times[warm_up - 1], color="0.94", zorder=0, label="not scored")
    left.fill_between(times, mean - deviation, mean + deviation, color=INK, alpha=0.2, linewidth=0,
                      label="± standard deviation")
    left.plot(times, mean, color=INK, linewidth=1.6, label="estimate")
    left.plot(times, true, color=GREY, linestyle="--", linewidth=1.4, label="truth")
    left.set(xlabel="time / ms", ylabel="mean velocity / (m/s)", xlim=(0, times[-1]))
    left.legend(frameon=False, fontsize=9)
    _final(right, run)
    for ax in (left, right):
        despine(ax)
    save_figure(figure, path)


def _final(ax: Axes, run: VelocityRun) -> None:
    curves = {"truth": run.env.true_velocity()[-1], "estimate": run.profiles[-1]}
    _profiles(ax, run.model, curves, vertical=False)
    T = len(run.estimates)
    ax.set(xlabel="y / cm", ylabel="velocity / (m/s)",
           ylim=(min(0.0, 1.1 * run.profiles[-1].min()), None))
    ax.set_title(f"profiles at the final step, {format_milliseconds(run.env, T)}", fontsize=10)
    ax.legend(frameon=False, fontsize=9, loc="lower center")


def _best_fit(model: VelocityModel, profile: np.ndarray) -> np.ndarray:
    """Project a ``profile`` (p,) in m/s on the basis profiles."""
    root = np.sqrt(model.weights)
    theta = np.linalg.lstsq(root[:, None] * model.profiles, root * profile, rcond=None)[0]
    return np.asarray(model.profiles @ theta)


def _relative_distance(model: VelocityModel, profile: np.ndarray, truth: np.ndarray) -> float:
    """Return the relative L2 distance across the pipe."""
    return float(np.sqrt(model.weights @ (profile - truth)**2 / (model.weights @ truth**2)))


def fig6_4(seeds: list[int], _jobs: int, out: Path) -> tuple[Path, str]:
    """Draw the asymmetric true profile and the three basis profiles."""
    env = _env("skewed")
    env.reset(seed=seeds[0])
    model = env.task.velocity
    truth = env.true_velocity()[0]
    assert model is not None
    fit = _best_fit(model, truth)
    figure = Figure(figsize=(10.4, 3.4), dpi=130, layout="constrained")
    left, right = figure.subplots(1, 2)
    _profiles(left, model, {"truth": truth}, vertical=False)
    left.lines[0].set_linestyle("-")
    left.set_title("true profile", fontsize=10)
    right.set_title("basis profiles", fontsize=10)
    left.set(xlabel="y / cm", ylabel="velocity / (m/s)", ylim=(0, None))
    y = np.linspace(-1, 1, 201)
    for k, (shape, colour) in enumerate(zip(model.basis, (INK, ACCENT, "#e09f3e"), strict=False)):
        right.plot(100 * model.half_width * y, np.polynomial.polynomial.polyval(y, shape),
                   color=colour, linewidth=1.6,
                   label=f"$\\varphi_{k + 1}$", linestyle=("-", "--", "-.")[k])
    right.axhline(0, color="0.8", linewidth=0.8, zorder=0)
    right.set(xlabel="y / cm", ylabel="basis profile / 1")
    right.legend(frameon=False)
    for ax in (left, right):
        despine(ax)
    path = out / "fig6.4.png"
    save_figure(figure, path)
    top = 100 * model.points[truth.argmax()]
    residual = _relative_distance(model, fit, truth)
    return path, "\n".join([
        f"The fastest fluid is {abs(top):.1f} cm {'above' if top > 0 else 'below'} the axis, at "
        f"{truth.max():.2f} m/s; "
        f"the projection on the three profiles has a relative L2 error of {100 * residual:.2f} %.",
        agreement_line("no combination of the basis equals the true profile", residual > 1e-6),
        "Not from the thesis: the true profile (1 − η²)·exp(kη) and the basis, a parabola, a cubic "
        "and a quartic."])


def fig6_5(seeds: list[int], _jobs: int, out: Path) -> tuple[Path, str]:
    """Draw the true and the estimated asymmetric profile at the final step."""
    run = run_joint_filter("skewed", seeds[0])
    figure = Figure(figsize=(5.6, 3.6), dpi=130, layout="constrained")
    ax = figure.subplots()
    _final(ax, run)
    despine(ax)
    path = out / "fig6.5.png"
    save_figure(figure, path)
    model, truth, last = run.model, run.env.true_velocity()[-1], run.profiles[-1]
    error = _relative_distance(model, last, truth)
    residual = _relative_distance(model, _best_fit(model, truth), truth)
    parabola = _relative_distance(model, model.profiles @ np.array(model.nominal), truth)
    side = np.sign(model.points[truth.argmax()])
    return path, "\n".join([
        f"At the final step the relative L2 error of the profile is {100 * error:.1f} %, of the "
        f"projection on the basis {100 * residual:.2f} %, of the prior {100 * parabola:.1f} %. "
        f"{_error_comparison(run)}",
        agreement_line("the error of the estimated profile is less than 15 %", error < 0.15),
        agreement_line("the maximum of the velocity is on the true side of the axis",
                       bool(np.sign(model.points[last.argmax()]) == side)),
        "Not from the thesis: the skewness of the sampled flow."])
