"""Choice of injections in measured data: `python studies/measured_injection.py ktc-1 ktc-2 ktc-3
ktc-4`, twenty minutes, and the same with `kit4-2.3 kit4-4.1 kit4-4.4`.

A policy chooses one of the measured injections after the other, without repetition; the estimate is
the one of log_map, from the chosen injections only. The table has the RMS error of predictions of
all other injections, in standard deviations of the noise, and, where the truth is known, the
challenge's score of the segmentation, after each number of injections; both are means over the
cases. Noise and prior of the task are fitted to all measurements of a file.
"""

from __future__ import annotations

import argparse
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from eitbench.bench.methods import builtin_methods, load_module
from eitbench.envs.measured import MeasuredEnv
from eitbench.estimation import StationaryMap, gauss_newton
from eitbench.estimation.nodal import initial_covariance
from eitbench.estimation.walk import matern_modes
from eitbench.measured.cases import read_case
from eitbench.measured.segmentation import ktc_score, segment

COUNTS = (2, 4, 8, 16, 32)
"""Numbers of injections after which estimates are scored."""
RANDOM_DRAWS = 5
POLICIES = ("file order", "evenly spaced", "random", "A-optimal in advance", "greedy A",
            "D-optimal in advance", "greedy D")


class Frame:
    """One frame of a case, each injection once, and its estimator.

    Parameters
    ----------
    name : str
        Name of a case with a stationary target.
    """

    def __init__(self, name: str) -> None:
        case = read_case(name)
        self.env = MeasuredEnv(case.measurements(), dict(case.vessel),
                               **(case.options | {"withheld": 0.0}))
        self.truth = case.truth_mask()
        task, measurements = self.env.task, self.env.measurements
        _, first = np.unique(measurements.injection_index, return_index=True)
        self.steps = np.sort(first)
        self.currents = measurements.currents[measurements.injection_index[self.steps]]
        self.voltages = measurements.voltages[self.steps]
        available = self.env.available[measurements.injection_index[self.steps]]
        self.voltages = np.where(available, self.voltages, np.nan)
        self.std = task.noise.std(np.nan_to_num(self.voltages))
        log_map = builtin_methods("estimation")["log_map"]
        exponential = load_module("estimator", log_map, log_map.read_bytes()).exponential
        self.estimator = StationaryMap(task, task.expected_concentration, exponential)
        self.penalty = np.linalg.inv(initial_covariance(task.mesh, task.prior))
        self.modes = task.prior.initial_std * matern_modes(task.mesh, task.prior.initial_length)

    def estimate(self, chosen: list[int], start: np.ndarray) -> np.ndarray:
        """Return u (n,) = ln c/c_0 from the chosen injections."""
        return gauss_newton(self.estimator, self.voltages[chosen], self.currents[chosen],
                            self.std[chosen], self.penalty, start)

    def score(self, chosen: list[int], u: np.ndarray) -> tuple[float, float]:
        """Return the RMS error of the other injections in standard deviations, and KTC's score, NaN
        without a truth."""
        others = np.setdiff1d(np.arange(len(self.steps)), chosen)
        predicted = self.estimator.voltages(u, self.currents[others])
        residual = (self.voltages[others] - predicted) / self.std[others]
        rms = float(np.sqrt(np.nanmean(residual**2)))
        if self.truth is None:
            return rms, np.nan
        c = self.env.task.expected_concentration * np.exp(u)
        return rms, ktc_score(self.truth, segment(self.env.vessel, self.env.task, c))

    def whitened(self, u: np.ndarray) -> np.ndarray:
        """Return the derivatives (K, M, r) of all measurements by the modes, over the noise."""
        jacobian = self.estimator.linearise(u, self.currents)[1] @ self.modes
        return np.where(np.isnan(self.voltages), 0.0, 1.0 / self.std)[..., None] * jacobian


class Choice(NamedTuple):
    """Criterion of a policy that chooses by variances."""

    is_d_optimal: bool
    is_adaptive: bool
    """about the present estimate, else about homogeneous fluid"""


def play(frame: Frame, order: np.ndarray | Choice) -> np.ndarray:
    """Return the scores (len(COUNTS), 2) of injections in this order, or of a choice."""
    u = np.zeros(len(frame.modes))
    chosen: list[int] = []
    scores = []
    derivatives = frame.whitened(u)
    covariance = np.eye(derivatives.shape[2])
    while len(chosen) < COUNTS[-1]:
        if isinstance(order, Choice):
            if order.is_adaptive and chosen:
                u = frame.estimate(chosen, u)
                derivatives = frame.whitened(u)
                covariance = posterior(derivatives[chosen].reshape(-1, derivatives.shape[2]))
            gains = criteria(derivatives, covariance, order.is_d_optimal)
            gains[chosen] = -np.inf
            chosen.append(int(gains.argmax()))
            if not order.is_adaptive:
                covariance = posterior(derivatives[chosen].reshape(-1, derivatives.shape[2]))
        else:
            chosen.append(int(order[len(chosen)]))
        if len(chosen) in COUNTS:
            u = frame.estimate(chosen, u)
            scores.append(frame.score(chosen, u))
    return np.array(scores)


def posterior(H: np.ndarray) -> np.ndarray:
    """Return the covariance (r, r) given measurements (m, r) with unit noise and prior."""
    return np.linalg.inv(np.eye(H.shape[1]) + H.T @ H)


def criteria(derivatives: np.ndarray, covariance: np.ndarray, is_d_optimal: bool) -> np.ndarray:
    """Return the A- or D-criterion (K,) of each injection."""
    cross = derivatives @ covariance
    S = cross @ derivatives.swapaxes(1, 2) + np.eye(derivatives.shape[1])
    if is_d_optimal:
        return np.asarray(np.linalg.slogdet(S)[1])
    gained = cross @ cross.swapaxes(1, 2)
    return np.asarray((np.linalg.inv(S) * gained).sum(axis=(1, 2)))


def scores_of(frame: Frame, policy: str) -> np.ndarray:
    """Return the mean scores (len(COUNTS), 2) of a policy."""
    count = len(frame.steps)
    if policy == "random":
        orders = [np.random.default_rng(draw).permutation(count) for draw in range(RANDOM_DRAWS)]
        return np.mean([play(frame, order) for order in orders], axis=0)
    if policy == "file order":
        return play(frame, np.arange(count))
    if policy == "evenly spaced":
        # binary digits reversed: each prefix is spread over all injections
        bits = int(np.ceil(np.log2(count)))
        spread = [int(f"{k:0{bits}b}"[::-1], 2) for k in range(2**bits)]
        return play(frame, np.array([k for k in spread if k < count]))
    return play(frame, Choice(policy.split()[0].startswith("D") or policy.endswith("D"),
                              policy.startswith("greedy")))


def main() -> None:
    parser = argparse.ArgumentParser(description="Scores by policy, in measured cases.")
    parser.add_argument("cases", nargs="+")
    frames = [Frame(name) for name in parser.parse_args().cases]
    print("| policy | " + " | ".join(f"{count}" for count in COUNTS) + " |\n|---|"
          + "---:|" * len(COUNTS))
    for policy in tqdm(POLICIES, disable=None):
        table = np.mean([scores_of(frame, policy) for frame in frames], axis=0)
        texts = [f"{rms:.1f}" if np.isnan(ktc) else f"{rms:.1f}, {ktc:.2f}" for rms, ktc in table]
        print(f"| {policy} | {' | '.join(texts)} |", flush=True)


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
