"""Speed of filters and smoothers: `python benchmarks/run.py filtering`.

First eitbench and peers with the same matrices: the pipe of `Pipe2D` on three meshes, from the same
mean and covariance after 60 steps, when the rank of Z has converged, in deviations from the
homogeneous estimate. Then the cost as a function of nodes, inflow modes and measurements, without
the forward solution.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import cycle, islice
from typing import NamedTuple

import numpy as np
from common import Row, compare, of_flops, peer
from pipe_record import STEPS, WARM_UP, pipe_model, problem, same

from eitbench.bench.methods import load_method
from eitbench.estimation import (
    DenseCovariance,
    Filter,
    ImpulseResponse,
    InflowPrior,
    InflowWindow,
    LinearMeasurement,
    LowRankCovariance,
    Motion,
    NodalStates,
    OpenLoopCovariance,
    fixed_interval_smoother,
    kalman_filter,
    smooth_means,
)
from eitbench.estimation.inflow_response import one_step_response
from eitbench.estimation.reduced import reduced_model
from eitbench.numerics.fem import mass_matrix
from eitbench.worlds.catalogue import PIPE_2D
from eitbench.worlds.registry import entry
from eitbench.worlds.task import make_task

CELLS = ((19, 4), (44, 10), (80, 20))
"""cells along and across the pipe: 100, 495 and 1,701 nodes"""
FINE = ((80, 20), (160, 40), (320, 80))
MODES, READINGS, MEMORY, SMOOTHED, REDUCED = (3, 6, 9, 18), (8, 16, 32, 64), 62, 320, 120
GOALS = (("Pipe2D", "real_time_filter", "≤ 0.004 s"), ("Pipe3D", "fast_inflow_filter", "≤ 0.015 s"))
NODAL, WINDOW = "filter step, Π − ZZᵀ", "filter step, inflow window"


class Model(NamedTuple):
    """Model x⁺ = F x + w, x₀ ~ N(mean, P), and measurements: H (T, m, n), values (T, m), std."""

    F: np.ndarray
    Q: np.ndarray
    mean: np.ndarray
    P: np.ndarray
    H: np.ndarray
    values: np.ndarray
    std: np.ndarray


Run = Callable[[], np.ndarray]
"""Returns the filtered means (T, n)."""


def row(what: str, ours: float, against: str = "–", theirs: float | None = None, *,
        target: str = "", limit: str = "", ceiling: str = "") -> Row:
    return Row("filtering", what, against, ours, theirs, target, limit, ceiling)


def rows() -> Iterator[Row]:
    for cells in CELLS:
        yield from against_peers(cells)
    yield from growth()
    yield from goals()


# -- peers -----------------------------------------------------------------------------------------


def against_peers(cells: tuple[int, int]) -> Iterator[Row]:
    """Compare a step with both forms of the covariance with each peer; all means must agree."""
    settled = problem(cells)
    level, F = settled.start.mean.copy(), settled.motion.transition
    kalman_filter(settled.start, settled.observations[:WARM_UP])
    mean, covariance = settled.start.mean - level, settled.start.covariance
    record = [seen._replace(value=seen.value - seen.matrix @ level)
              for seen in settled.observations[WARM_UP:]]
    H, values, variances = (np.stack(part) for part in list(zip(*record, strict=True))[:3])
    model = Model(F, settled.noise, mean, covariance.array, H, values, np.sqrt(variances))
    n, rank = covariance.assimilated.shape

    def ours(covariance, noise=None) -> np.ndarray:
        start = Filter(NodalStates(mean, covariance, Motion(F, 0.0, noise)))
        return np.array([step.mean for step in kalman_filter(start, record)])

    forms = {"Π − ZZᵀ": (lambda: ours(covariance), 2.0 * n**2 * (rank + 16) + 4.0 * n * rank**2),
             "dense": (lambda: ours(DenseCovariance(model.P), model.Q), 3.0 * n**3)}
    expected = ours(covariance)
    for name, function in (("numpy", textbook), ("filterpy", filterpy), ("dynamax", dynamax),
                           ("cuthbert", cuthbert)):
        runs = {form: run for form, (run, _) in forms.items()}
        try:
            runs["theirs"] = function(model)
            same(runs["theirs"](), expected, 1e-6)                     # compiles and warms up, too
        except ImportError:
            runs.pop("theirs", None)
        seconds = compare(runs, 1 if n > 1500 else 5, warm_up=n < 1500)
        for form, (_, flops) in forms.items():
            step = seconds[form] / STEPS
            yield row(f"filter step, n = {n}, 16 measurements, {form}", step, peer(name),
                      seconds["theirs"] / STEPS if "theirs" in seconds else None,
                      limit="flops", ceiling=of_flops(flops, step))


def textbook(model: Model) -> Run:
    """Return the textbook filter: F P Fᵀ + Q, S, K, P − K (H P)."""
    def run() -> np.ndarray:
        mean, P, means = model.mean, model.P, []
        for H, value, std in zip(model.H, model.values, model.std, strict=True):
            mean, P = model.F @ mean, model.F @ P @ model.F.T + model.Q
            K = np.linalg.solve(H @ P @ H.T + np.diag(std**2), H @ P).T
            mean, P = mean + K @ (value - H @ mean), P - K @ (H @ P)
            means.append(mean)
        return np.array(means)
    return run


def filterpy(model: Model) -> Run:
    from filterpy.kalman import KalmanFilter
    them = KalmanFilter(dim_x=len(model.F), dim_z=16)
    them.F, them.Q = model.F, model.Q

    def run() -> np.ndarray:
        them.x, them.P, means = model.mean[:, None], model.P.copy(), []
        for H, value, std in zip(model.H, model.values, model.std, strict=True):
            them.predict()
            them.update(value[:, None], R=np.diag(std**2), H=H)
            means.append(them.x[:, 0])
        return np.array(means)
    return run


def dynamax(model: Model) -> Run:
    """Return dynamax's compiled filter, in units in which the 1e-9 it adds to S is negligible."""
    import jax
    jax.config.update("jax_enable_x64", True)
    from dynamax.linear_gaussian_ssm import lgssm_filter
    from dynamax.linear_gaussian_ssm.inference import make_lgssm_params
    units, F = 1e-4, model.F
    parameters, record = jax.device_put((make_lgssm_params(
        F @ model.mean / units, (F @ model.P @ F.T + model.Q) / units**2, F, model.Q / units**2,
        model.H * units / model.std[..., None], np.stack([np.eye(16)] * STEPS)),
        model.values / model.std))
    compiled = jax.jit(lgssm_filter)
    return lambda: units * np.asarray(compiled(parameters, record).filtered_means)


def cuthbert(model: Model) -> Run:
    """Return cuthbert's compiled square-root filter."""
    import jax
    jax.config.update("jax_enable_x64", True)
    import cuthbert as them
    from cuthbert.gaussian import kalman

    def root(covariance: np.ndarray) -> np.ndarray:
        values, vectors = np.linalg.eigh(covariance)
        return vectors * np.sqrt(np.maximum(values, 0.0))

    def run(F, Q, mean, P, *record):
        zero = jax.numpy.zeros_like
        filter_ = kalman.build_filter(
            mean, P, lambda inputs: (F, zero(mean), Q),
            lambda inputs: (inputs[0], zero(inputs[1]), jax.numpy.diag(inputs[2]), inputs[1]))
        return them.filter(filter_, record, filter_.init_prepare()).mean[1:]

    arguments = jax.device_put(model._replace(Q=root(model.Q), P=root(model.P)))
    compiled = jax.jit(run)
    return lambda: np.asarray(compiled(*arguments))


# -- growth ----------------------------------------------------------------------------------------


def growth() -> Iterator[Row]:
    """Yield the cost of a step as a function of nodes, measurements and inflow modes."""
    for cells in FINE:
        transport = pipe_model(cells).transport
        n = transport.mesh.n_nodes
        if n < 10_000:
            filter_ = nodal(transport)
            for m in READINGS if n < 2000 else (16,):
                yield row(f"{NODAL}, n = {n}, {m} measurements", step_seconds(filter_, n, m),
                          limit="flops: F Z" if n < 2000 else "flops: F Z; with 26,001 nodes F and "
                          "Π take 5.4 GB each, and computing Π three times as much")
        for modes in MODES if n < 2000 else (9,):
            filter_ = window(transport, modes)
            for m in READINGS if (n < 2000 and modes == 9) else (16,):
                yield row(f"{WINDOW}, n = {n}, {modes} modes, {m} measurements",
                          step_seconds(filter_, n, m), limit="bytes: P, moved and updated")


def step_seconds(filter_: Filter, n: int, m: int) -> float:
    """Return the seconds of the fastest of `STEPS` predictions and updates after `WARM_UP`."""
    rng, times = np.random.default_rng(0), []
    for _ in range(WARM_UP + STEPS):
        seen = LinearMeasurement(rng.random((m, n)) / n, 30.0 + 0.3 * rng.normal(size=m),
                                 np.full(m, 0.1))
        begin = time.perf_counter()
        filter_.predict()
        filter_.update(seen)
        times.append(time.perf_counter() - begin)
    return min(times[WARM_UP:])


def nodal(transport) -> Filter:
    """Return the filter of the concentration at the nodes, from its stationary covariance."""
    model, level = transport.evolution_model(), PIPE_2D.expected_concentration
    noise = level**2 * model.state_noise_covariance(PIPE_2D.prior.inflow_std**2,
                                                    PIPE_2D.prior.nodal_std**2)
    covariance = LowRankCovariance(OpenLoopCovariance.of(model.F, noise), 1e-4)
    forcing = level * model.Y.sum(axis=1)
    return Filter(NodalStates(np.full(len(noise), level), covariance, Motion(model.F, forcing)))


def window(transport, modes: int) -> Filter:
    """Return the filter of the inflow's logarithm, with cosines across the inlet as modes."""
    points = transport.mesh.points[transport.inlet]
    across = np.arange(len(points))[:, None] / (len(points) - 1)
    E = 0.1 * np.cos(np.pi * across * np.arange(modes))
    parts = [one_step_response(transport)]
    while len(parts) < MEMORY:
        parts.append(transport.step(parts[-1], parts[-1][transport.inlet], 0.0))
    reach = np.concatenate([part @ E for part in parts], axis=1)
    squares, right = np.linalg.eigh(reach.T @ reach)
    keep = squares > 1e-6 * squares[-1]
    basis = reach @ (right[:, keep] / np.sqrt(squares[keep]))
    response = ImpulseResponse(basis, np.stack([basis.T @ part for part in parts], axis=1))
    prior = InflowPrior("logarithm", points, E, 0.9**np.arange(6)**2, transport.time_step)
    task = replace(make_task(PIPE_2D), transport=transport)
    return Filter(InflowWindow(task, prior, PIPE_2D.expected_concentration, responses=[response]))


def goals() -> Iterator[Row]:
    """Yield steps of complete methods, including the forward solution, and smoothing of a long
    measurement sequence."""
    for name, method, target in GOALS:
        task = make_task(entry(f"eitbench/{name}-v0").world)
        estimator = load_method(method, "estimation").make(task)
        currents = list(islice(cycle(task.currents), task.n_steps))
        voltages = task.observation.voltages(
            np.full(task.mesh.n_nodes, task.expected_concentration), task.currents)
        times = []
        for each in zip(cycle(voltages), currents, strict=False):
            begin = time.perf_counter()
            estimator.update(*each)
            times.append(time.perf_counter() - begin)
        yield row(f"{method}, a step on {name}", min(times[task.n_steps // 2:]), target=target)
    record = problem(CELLS[-1], SMOOTHED)
    mass = mass_matrix(pipe_model(CELLS[-1]).transport.mesh).toarray()
    basis, A, Q, P = reduced_model(copy.copy(record.start), mass, record.observations[:WARM_UP],
                                   REDUCED)
    few = Filter(NodalStates(np.zeros(REDUCED), DenseCovariance(P), Motion(A, 0.0, Q)))
    level = record.start.mean.copy()
    projected = [seen._replace(matrix=seen.matrix @ basis, value=seen.value - seen.matrix @ level)
                 for seen in record.observations]
    for what, smooth, start, seen in (
            (f"means, {REDUCED} reduced coordinates", smooth_means, few, projected),
            ("means, n = 1701", smooth_means, record.start, record.observations),
            ("variances, n = 1701", fixed_interval_smoother, record.start, record.observations)):
        begin = time.perf_counter()
        smooth(copy.copy(start), seen)
        yield row(f"smoothing {SMOOTHED} steps, {what}", time.perf_counter() - begin,
                  target="≤ 1 s")
