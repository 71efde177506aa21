"""How much moves, and how noisy readings are: by what a record of them makes likeliest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from eitbench.estimation.kalman import LinearisedObservations
from eitbench.estimation.measured.record import shown_reading
from eitbench.estimation.modes import ModesFilter
from eitbench.estimation.walk import smooth_modes, steady
from eitbench.worlds.task import Task

if TYPE_CHECKING:
    from eitbench.data.measured import Measurements

SPANS, FRAMES = 3, 2
"""So many times so many frames one after another are looked at, evenly over the record."""
STARTS = {"noise": 3.0, "initial": 0.3, "walk": 0.03}
LIMITS = {"initial": (1e-2, 1.0), "walk": (1e-4, 1.0)}
"""Standard deviations in parts of the background."""
RATES = (1e-2, 3.0)
"""1/λ over the duration of a frame, from the least to the largest that is looked at."""
NOISE = {True: (1.0, 1e3), False: (0.1, 10.0)}
"""Factor of a noise that repeats have told, to which the model's error comes, and of one that holds
all that the model does not explain, of which a correction leaves a tenth at least."""


def likeliest(task: Task, record: Measurements, *, noise_is_told: bool, initial_is_known: bool,
              walk_is_known: bool) -> Task:
    """The task with the noise's factor, the initial and the walk's standard deviation under which
    a linearised Kalman filter expects some frames best: the largest marginal likelihood.

    The filter works on the modes of the smoothness prior, which the initial state and each step of
    the walk share.
    """
    free = [name for name, known in (("noise", False), ("initial", initial_is_known),
                                     ("walk", walk_is_known)) if not known]
    limits = LIMITS | {"noise": NOISE[noise_is_told]}
    surprise = _Surprise(task, record)
    given = {"noise": 1.0, "initial": task.prior.initial_std, "walk": task.prior.nodal_std}

    def numbers(x: np.ndarray) -> dict[str, float]:
        return given | {name: float(np.exp(value)) for name, value in zip(free, x, strict=True)}

    def surprised(x: np.ndarray) -> float:
        said = numbers(x)
        memory = remembered(said["initial"], said["walk"])
        return surprise(said["noise"], said["initial"], partial(_forgetting, memory))

    found = minimize(surprised, np.log([STARTS[name] for name in free]),
                     method="Nelder-Mead", bounds=np.log([limits[name] for name in free]),
                     options={"xatol": 0.03, "fatol": 0.1, "maxfev": 60 * len(free)})
    best = numbers(found.x)
    noise = task.noise
    factor = best["noise"]
    return replace(
        task, noise=replace(noise, relative=factor * noise.relative,
                            of_largest=factor * noise.of_largest, floor=factor * noise.floor),
        prior=replace(task.prior, initial_std=best["initial"],
                      nodal_std=min(best["walk"], best["initial"])))


def likeliest_rate(task: Task, record: Measurements) -> float:
    """λ in 1/s of `steady` motion under which the same frames are likeliest, with the task's noise
    and initial standard deviation."""
    surprise = _Surprise(task, record)
    frame = max(task.warm_up, 1)
    found = minimize_scalar(
        lambda x: surprise(1.0, task.prior.initial_std, lambda steps: steady(np.exp(x) * steps)),
        bounds=np.log([each / frame for each in RATES]), method="bounded", options={"xatol": 0.05})
    return float(np.exp(found.x)) / task.transport.time_step


def _forgetting(memory: float, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """As `steady`, of a walk that forgets."""
    kept = memory**steps
    return np.array([[kept]]), np.array([[1.0 - kept**2]])


def remembered(initial: float, walk: float) -> float:
    """φ with which a walk of this standard deviation keeps the variance of the initial state."""
    return float(np.sqrt(max(1.0 - (walk / initial)**2, 0.0)))


class _Surprise:
    """−2 ln of how likely some frames are, but for a constant."""

    def __init__(self, task: Task, record: Measurements) -> None:
        frames = FRAMES * task.calibration
        begins = np.linspace(0, max(task.n_steps - frames, 0), SPANS).round().astype(int)
        looked_at = np.unique(np.minimum(begins[:, None] + np.arange(frames), task.n_steps - 1))
        self._steps = np.diff(looked_at, prepend=-1)
        """from one to the next"""
        background = task.expected_concentration
        modes = background * smooth_modes(task.mesh, task.prior.initial_length)
        point = np.full(task.mesh.n_nodes, background)
        linear = LinearisedObservations(task.observation, task.noise, point)
        self._shown = []
        for voltages, currents in (shown_reading(task, record, t) for t in looked_at):
            H, value, variance = linear(voltages, currents)
            seen = H.any(axis=1)
            self._shown.append(((H[seen] @ modes), (value - H @ point)[seen], variance[seen]))

    def __call__(self, noise: float, initial: float,
                 motion: Callable[[int], tuple[np.ndarray, np.ndarray]]) -> float:
        filter = ModesFilter(self._shown[0][0].shape[1], initial, len(motion(1)[0]))
        total = 0.0
        for steps, (H, value, variance) in zip(self._steps, self._shown, strict=True):
            filter.predict(*motion(int(steps)))
            innovation, S = filter.update(H, value - H @ filter.mean, noise**2 * variance)
            total += float(innovation @ np.linalg.solve(S, innovation))
            total += float(np.linalg.slogdet(S)[1])
        return total
