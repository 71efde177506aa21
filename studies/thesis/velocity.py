"""Figures 6.1 to 6.6 of the thesis: the flow is estimated too."""

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
    INK,
    TRUE,
    bare,
    draw_fields,
    error_of,
    estimates_of,
    milliseconds,
    save,
    shown_times,
    verdict,
)

METHOD = "joint_extended_kalman_filter"


class Run(NamedTuple):
    """An episode in which the flow was estimated."""

    env: EstimationEnv
    estimates: list[Estimate]
    error: float
    """ẽ_c"""
    fallbacks: dict[str, float]
    """ẽ_c of simpler methods on the same episode"""

    @property
    def model(self) -> VelocityModel:
        model = self.env.task.velocity
        assert model is not None
        return model

    @property
    def parameters(self) -> np.ndarray:
        """(T, k) estimated θ in m/s; what is believed at first until there is an estimate."""
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
        """Mean over the pipe's width of (..., p) velocities."""
        return profiles @ self.model.weights / self.model.weights.sum()

    def times(self) -> np.ndarray:
        """(T,) ms."""
        return 1e3 * self.env.task.transport.time_step * np.arange(1, len(self.estimates) + 1)


def _env(flow: str) -> EstimationEnv:
    """The pipe whose flow is "unknown", "time-varying" or "skewed"."""
    kind = {"unknown": "Unknown", "time-varying": "TimeVarying", "skewed": "Skewed"}[flow]
    return EstimationEnv(f"eitbench/Pipe2D{kind}Velocity-v0")


@lru_cache(maxsize=3)
def run(flow: str, seed: int) -> Run:
    """One episode, played once for all figures that show it."""
    env = _env(flow)
    fallbacks = {name: error_of(env, estimates_of(env, name, seed))
                 for name in ("kalman_filter", "filter_bank")}
    estimates = estimates_of(env, METHOD, seed)
    return Run(env, estimates, error_of(env, estimates), fallbacks)


def _beside(played: Run) -> str:
    fallbacks = played.fallbacks
    trusted = played.model.nominal[0]
    return (f"ẽ_c is {played.error:.4f}; {fallbacks['kalman_filter']:.4f} for the Kalman "
            "filter that "
            f"trusts {trusted:g} m/s, {fallbacks['filter_bank']:.4f} for a bank of nine filters.")


# -- pictures --------------------------------------------------------------------------------------


def fig6_1(seeds: list[int], _jobs: int, out: Path) -> tuple[Path, str]:
    """Parabolic flow: concentration and velocity, true and estimated."""
    return _states(run("unknown", seeds[0]), out / "fig6.1.png")


def fig6_6(seeds: list[int], _jobs: int, out: Path) -> tuple[Path, str]:
    """The flow that is not symmetric: concentration and velocity, true and estimated."""
    return _states(run("skewed", seeds[0]), out / "fig6.6.png")


def _states(played: Run, path: Path) -> tuple[Path, str]:
    env = played.env
    times = shown_times(env)
    figure = Figure(figsize=(10.4, 0.98 * len(times) + 0.8), dpi=130, layout="constrained")
    axes = figure.subplots(len(times), 3, sharey=True, width_ratios=(1, 1, 0.42))
    mappable = draw_fields(env, axes[:, :2], times, [played.estimates])
    true, estimated = env.true_velocity(), played.profiles
    for ax, t in zip(axes[:, 2], times, strict=True):
        _profiles(ax, played.model, {"truth": true[t - 1], "estimate": estimated[t - 1]},
                  across=True)
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
    save(figure, path)
    off = _relative(played, slice(env.task.warm_up, None))
    return path, "\n".join([
        f"{_beside(played)} ẽ_v, squared like ẽ_c, is {off:.5f}.",
        verdict("estimating the flow too is worth it: ẽ_c is smaller than with the flow believed "
                "at first",
                played.error < played.fallbacks["kalman_filter"]),
        verdict("the estimated velocity is close to the true one: within 15 % (ẽ_v < 0.0225)",
                off < 0.15**2),
        "By choice: inflow, electrodes, injections and the drawn flow are ours."])


def _heights(env: EstimationEnv) -> tuple[float, float]:
    """Lowest and highest point of the pipe, cm."""
    y = 100 * env.task.mesh.points[:, 1]
    return float(y.min()), float(y.max())


def _relative(played: Run, steps: slice) -> float:
    """∫(v̂ − v)² / ∫v² across the pipe, averaged over the steps."""
    return scoring.relative_error(played.profiles[steps], played.env.true_velocity()[steps],
                                  np.diag(played.model.weights))


def _profiles(ax: Axes, model: VelocityModel, curves: dict[str, np.ndarray], *,
              across: bool) -> None:
    """Velocity profiles (m/s), zero on the walls; ``across``: the height is the vertical axis."""
    R = model.half_width
    y = 100 * np.linspace(-R, R, 101)
    for label, profile in curves.items():
        v = CubicSpline(100 * np.concatenate([[-R], model.points, [R]]), np.pad(profile, 1))(y)
        colour, line = (TRUE, ":") if label == "truth" else (INK, "-")
        ax.plot(*((v, y) if across else (y, v)), linewidth=1.6, label=label, color=colour,
                linestyle=line)


# -- curves ----------------------------------------------------------------------------------------


def fig6_2(seeds: list[int], _jobs: int, out: Path) -> tuple[Path, str]:
    """Parabolic flow of unknown mean velocity: its estimate over time, and the profile at the
    end."""
    played = run("unknown", seeds[0])
    path = out / "fig6.2.png"
    _over_time(played, path)
    true, mean = played.mean(played.env.true_velocity()), played.mean(played.profiles)
    warm_up = played.env.task.warm_up
    deviation = played.deviations[:, 0]
    off = np.abs(mean - true)[warm_up:]
    return path, "\n".join([
        f"The true mean velocity is {true[-1]:.2f} m/s, the last estimate {mean[-1]:.2f} ± "
        f"{deviation[-1]:.2f}. "
        f"After the warm-up it is {100 * (off / true[warm_up:]).max():.1f} % off at most, and the "
        "truth lies within "
        f"one standard deviation {100 * np.mean(off < deviation[warm_up:]):.0f} % of the time. "
        f"{_beside(played)}",
        verdict("after the warm-up the mean velocity is within 10 % of the truth",
                bool((off < 0.1 * true[warm_up:]).all())),
        "By choice: what is believed at first, 4.5 ± 1 m/s, and the random walk are ours."])


def fig6_3(seeds: list[int], _jobs: int, out: Path) -> tuple[Path, str]:
    """Parabolic flow that changes in time: its estimate over time, and the profile at the end."""
    played = run("time-varying", seeds[0])
    path = out / "fig6.3.png"
    _over_time(played, path)
    warm_up = played.env.task.warm_up
    true, mean = (played.mean(each)[warm_up:]
                  for each in (played.env.true_velocity(), played.profiles))
    rms, constant = np.sqrt(np.mean((mean - true)**2)), true.std()
    lag, correlation = lag_of(mean, true)
    return path, "\n".join([
        f"The mean velocity runs from {true.min():.2f} to {true.max():.2f} m/s; the estimate is "
        f"{rms:.2f} m/s off "
        f"(root mean square), the best constant would be {constant:.2f}. It follows {lag} "
        f"injections behind (correlation {correlation:.2f}). {_beside(played)}",
        verdict("the estimate follows the changing velocity: closer than any constant",
                bool(rms < constant)),
        verdict("it follows with a visible lag: one injection or more", lag >= 1),
        "By choice: amplitude and period of the change are ours; the model expects a random walk."])


def lag_of(estimate: np.ndarray, truth: np.ndarray, longest: int = 20) -> tuple[int, float]:
    """The delay (steps ≥ 0) at which ``estimate`` correlates best with ``truth``, and that
    correlation."""
    longest = min(longest, len(truth) // 3)
    correlations = [np.corrcoef(estimate[lag:], truth[:len(truth) - lag])[0, 1]
                    for lag in range(longest + 1)]
    best = int(np.argmax(correlations))
    return best, float(correlations[best])


def _over_time(played: Run, path: Path) -> None:
    times = played.times()
    warm_up = played.env.task.warm_up
    true, mean, deviation = (played.mean(played.env.true_velocity()), played.mean(played.profiles),
                             played.deviations[:, 0])       # the one parameter is the mean velocity
    figure = Figure(figsize=(10.4, 3.4), dpi=130, layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.6, 1))
    left.axvspan(0, times[warm_up - 1], color="0.94", zorder=0, label="not scored")
    left.fill_between(times, mean - deviation, mean + deviation, color=INK, alpha=0.2, linewidth=0,
                      label="± standard deviation")
    left.plot(times, mean, color=INK, linewidth=1.6, label="estimate")
    left.plot(times, true, color=TRUE, linestyle="--", linewidth=1.4, label="truth")
    left.set(xlabel="time / ms", ylabel="mean velocity / (m/s)", xlim=(0, times[-1]))
    left.legend(frameon=False, fontsize=9)
    _final(right, played)
    for ax in (left, right):
        bare(ax)
    save(figure, path)


def _final(ax: Axes, played: Run) -> None:
    curves = {"truth": played.env.true_velocity()[-1], "estimate": played.profiles[-1]}
    _profiles(ax, played.model, curves, across=False)
    T = len(played.estimates)
    ax.set(xlabel="y / cm", ylabel="velocity / (m/s)",
           ylim=(min(0.0, 1.1 * played.profiles[-1].min()), None))
    ax.set_title(f"profiles at the final step, {milliseconds(played.env, T)}", fontsize=10)
    ax.legend(frameon=False, fontsize=9, loc="lower center")


def _best_fit(model: VelocityModel, profile: np.ndarray) -> np.ndarray:
    """The combination of the basis profiles that is closest to ``profile``, (p,) m/s."""
    root = np.sqrt(model.weights)
    theta = np.linalg.lstsq(root[:, None] * model.profiles, root * profile, rcond=None)[0]
    return np.asarray(model.profiles @ theta)


def _distance(model: VelocityModel, profile: np.ndarray, truth: np.ndarray) -> float:
    """Relative L2 distance across the pipe."""
    return float(np.sqrt(model.weights @ (profile - truth)**2 / (model.weights @ truth**2)))


def fig6_4(seeds: list[int], _jobs: int, out: Path) -> tuple[Path, str]:
    """The true profile that is not symmetric, and the three basis profiles."""
    env = _env("skewed")
    env.reset(seed=seeds[0])
    model = env.task.velocity
    truth = env.true_velocity()[0]
    assert model is not None
    fit = _best_fit(model, truth)
    figure = Figure(figsize=(10.4, 3.4), dpi=130, layout="constrained")
    left, right = figure.subplots(1, 2)
    _profiles(left, model, {"truth": truth}, across=False)
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
        bare(ax)
    path = out / "fig6.4.png"
    save(figure, path)
    top = 100 * model.points[truth.argmax()]
    residual = _distance(model, fit, truth)
    return path, "\n".join([
        f"The fastest fluid is {abs(top):.1f} cm {'above' if top > 0 else 'below'} the axis, at "
        f"{truth.max():.2f} m/s; "
        f"the best combination of the three profiles leaves {100 * residual:.2f} % (relative L2).",
        verdict("no combination of the basis equals the true profile", residual > 1e-6),
        "By choice: the true profile is (1 − η²)·exp(kη), the basis a parabola, a cubic and a "
        "quartic."])


def fig6_5(seeds: list[int], _jobs: int, out: Path) -> tuple[Path, str]:
    """The flow that is not symmetric: true and estimated profile at the final step."""
    played = run("skewed", seeds[0])
    figure = Figure(figsize=(5.6, 3.6), dpi=130, layout="constrained")
    ax = figure.subplots()
    _final(ax, played)
    bare(ax)
    path = out / "fig6.5.png"
    save(figure, path)
    model, truth, last = played.model, played.env.true_velocity()[-1], played.profiles[-1]
    off, residual = _distance(model, last, truth), _distance(model, _best_fit(model, truth), truth)
    parabola = _distance(model, model.profiles @ np.array(model.nominal), truth)
    side = np.sign(model.points[truth.argmax()])
    return path, "\n".join([
        f"At the final step the profile is {100 * off:.1f} % off (relative L2); the best "
        "combination of the basis "
        f"leaves {100 * residual:.2f} %, what was believed at first is {100 * parabola:.1f} % off. "
        f"{_beside(played)}",
        verdict("the estimated profile is close to the true one: less than 15 % off", off < 0.15),
        verdict("the fastest fluid is found on the right side of the axis",
                bool(np.sign(model.points[last.argmax()]) == side)),
        "By choice: how skewed the drawn flow is."])
