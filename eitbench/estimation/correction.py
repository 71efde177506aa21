"""Recurrent networks that correct estimates: inference in numpy (``docs/learn.md``).

A network is a file of plain arrays. It works in modes B of c/ĉ_bh − 1: from the features of a time
step it predicts a correction of the modes and the variance of each corrected mode.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from eitbench.estimation.estimators import Measurement
from eitbench.estimation.identified import IdentifiedModel, has_fingerprint
from eitbench.estimation.inflow_prior import InflowPrior
from eitbench.estimation.inflow_window import inflow_filter
from eitbench.worlds.task import Estimate, Task

Network = Mapping[str, np.ndarray]


@lru_cache(maxsize=4)
def load_network(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of a network in double precision."""
    with np.load(path) as file:
        return {name: file[name].astype(float) for name in file.files}


def network_matches_task(path: Path, task: Task) -> bool:
    """Return whether the network at ``path`` exists and was trained for this vessel, these
    injections and this flow model."""
    if not path.is_file():
        return False
    known = load_network(path)
    return (task.velocity is None and task.mesh.n_nodes == len(known["basis"])
            and has_fingerprint(task, known["task"]))


# -- the network -----------------------------------------------------------------------------------


def gru_step(network: Network, inputs: np.ndarray, hidden_state: np.ndarray | None,
             direction: str = "") -> np.ndarray:
    """Return the new hidden state (h,) of a gated recurrent unit (Cho et al. 2014).

    ``inputs`` (d,) are not scaled; None is the state before the first input; ``direction`` is
    ``"backward_"`` for the backward unit.
    """
    if hidden_state is None:
        hidden_state = np.zeros(network["hidden_weight"].shape[1])
    inputs = inputs / network["input_scale"]
    seen = network[f"{direction}input_weight"] @ inputs + network[f"{direction}input_bias"]
    kept = network[f"{direction}hidden_weight"] @ hidden_state + network[f"{direction}hidden_bias"]
    seen_reset, seen_keep, seen_new = np.split(seen, 3)
    kept_reset, kept_keep, kept_new = np.split(kept, 3)
    reset = _sigmoid(seen_reset + kept_reset)
    keep = _sigmoid(seen_keep + kept_keep)
    return (1.0 - keep) * np.tanh(seen_new + reset * kept_new) + keep * hidden_state


def apply_correction(network: Network, c_ref: float, reduced: np.ndarray, inputs: np.ndarray,
                     hidden_state: np.ndarray) -> Estimate:
    """Return ĉ_bh (1 + B (a + Δ)) and its variance, for the modes a = ``reduced`` (q,).

    Δ is a linear map of the hidden state (of both directions), plus linear maps of the inputs (d,)
    with weights from the hidden state.
    """
    outputs = network["output_weight"] @ hidden_state + network["output_bias"]
    linear, log_variance = np.split(outputs, 2)
    mixing = network["mixing_weight"] @ hidden_state + network["mixing_bias"]
    scale = network["output_scale"]
    correction = scale * (linear + mixing @ (network["maps"] @ (inputs / network["input_scale"])))
    basis = network["basis"]
    mean = 1.0 + basis @ (reduced + correction)
    variance = basis**2 @ (scale**2 * np.exp(log_variance)) + network["rest"]
    return Estimate(c_ref * mean, c_ref**2 * variance)


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-x))


# -- features --------------------------------------------------------------------------------------


class FilterFeatures:
    """Features of an episode from the filter of the `InflowWindow`, in modes ``basis`` (n, q) of
    c/ĉ_bh − 1; the other arguments are as in `inflow_filter`."""

    def __init__(self, task: Task, prior: InflowPrior, c_ref: float, basis: np.ndarray,
                 lag: int = 0, model: IdentifiedModel | None = None) -> None:
        self.task = task
        self.reduce = np.linalg.pinv(basis)
        self.c_ref = c_ref
        self.filter = inflow_filter(task, prior, c_ref, lag, model=model,
                                    iterated=model is not None)

    def __call__(self, voltages: np.ndarray, currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the inputs (d,) and the filter's modes (q,) after this measurement vector: inputs
        are the innovation relative to the noise, the modes, their change by the update, and the
        one-hot code of the injection."""
        step = self.filter.assimilate(voltages, currents)
        before = self._modes(self.filter.space.concentration(step.predicted_mean))
        innovation = step.innovation
        after = self.modes()
        std = self.task.noise.std(voltages - innovation)
        return np.concatenate([np.arcsinh(innovation / std), after, after - before,
                               injection_one_hot(self.task, currents)]), after

    def modes(self, lag: int = 0) -> np.ndarray:
        """Return the modes (q,) of the filter's mean ``lag`` steps ago."""
        return self._modes(self.filter.space.concentration(self.filter.mean, lag))

    def _modes(self, concentration: np.ndarray) -> np.ndarray:
        return self.reduce @ (concentration / self.c_ref - 1.0)

    def record(self, record: Sequence[Measurement],
               *lags: int) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return the inputs (T, d) of T measurement vectors, and for each of ``lags`` the modes
        (T, q) of each state, as estimated that many steps later or at the end."""
        inputs = []
        modes: list[list[np.ndarray]] = [[] for _ in lags]
        for t, (voltages, currents) in enumerate(record):
            inputs.append(self(voltages, currents)[0])
            for lag, known in zip(lags, modes, strict=True):
                if t >= lag:
                    known.append(self.modes(lag))
        for known in modes:
            known += [self.modes(ago) for ago in reversed(range(len(record) - len(known)))]
        return np.array(inputs), [np.array(known) for known in modes]


class VoltageFeatures:
    """Features of an episode from voltages alone; parameters as for `FilterFeatures`."""

    def __init__(self, task: Task, c_ref: float, basis: np.ndarray) -> None:
        self.task = task
        self.c_ref = c_ref
        homogeneous = np.full(task.mesh.n_nodes, c_ref)
        self.expected = task.observation.voltages(homogeneous, task.currents)
        self.none = np.zeros(basis.shape[1])

    def __call__(self, voltages: np.ndarray, currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the inputs (frame·L,), deviations of the voltages from a homogeneous fluid
        relative to the noise, zero for other injections, and zero modes (q,)."""
        here = injection_one_hot(self.task, currents)
        expected = here @ self.expected
        off = (voltages - expected) / self.task.noise.std(expected)
        return np.outer(here, off).ravel(), self.none


# -- filter ----------------------------------------------------------------------------------------


class NetworkCorrectedFilter:
    """Filter with a network correction of its ``features``, for `FilterEstimator`.

    After the last measurement, when the lag shrinks, it returns the estimates of the filter alone.
    `VoltageFeatures` have no lag.
    """

    def __init__(self, network: Network, features: FilterFeatures | VoltageFeatures) -> None:
        self.network = network
        self.features = features
        self.lag = features.task.lag
        self._hidden_state: np.ndarray | None = None
        self._measured = 0

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> None:
        """Pass one measurement vector, (L,) in V and in A, to the network."""
        inputs, reduced = self.features(voltages, currents)
        self._measured += 1
        if self.lag and isinstance(self.features, FilterFeatures):
            if self._measured <= self.lag:
                return
            reduced = self.features.modes(self.lag)
            inputs = np.concatenate([inputs, reduced])
        self._hidden_state = gru_step(self.network, inputs, self._hidden_state)
        self._last = reduced, inputs, self._hidden_state

    def estimate(self, lag: int = 0) -> Estimate:
        """Return the state ``lag`` steps ago."""
        if lag < self.lag:
            assert isinstance(self.features, FilterFeatures)
            return self.features.filter.estimate(lag)
        return apply_correction(self.network, self.features.c_ref, *self._last)


def injection_one_hot(task: Task, currents: np.ndarray) -> np.ndarray:
    """Return (frame,) one for this injection of the task's cycle, zero for the others."""
    return (task.currents == currents).all(axis=1).astype(float)
