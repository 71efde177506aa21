"""Recurrent networks that say by how much an estimate is off (``docs/learn.md``): what plays them,
in numpy alone.

A network is a file of plain arrays. It works in modes B of c/ĉ_bh − 1: from what is seen of a step
it says a correction of the modes, and the variance of each.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from eitbench.estimation.estimators import FilterEstimator, Measurement
from eitbench.estimation.identified import FINGERPRINT_ATOL, task_fingerprint
from eitbench.estimation.inflow_window import inflow_filter
from eitbench.worlds.task import Estimate

if TYPE_CHECKING:
    from eitbench.estimation.identified import IdentifiedModel
    from eitbench.estimation.inflow_prior import InflowPrior
    from eitbench.worlds.task import Task

Network = Mapping[str, np.ndarray]


@lru_cache(maxsize=4)
def load_network(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a network, in double precision."""
    with np.load(path) as file:
        return {name: file[name].astype(float) for name in file.files}


def network_matches_task(path: Path, task: Task) -> bool:
    """Whether the network at ``path`` is there and was trained for this vessel, these injections
    and this model of the flow."""
    if not path.is_file():
        return False
    known = load_network(path)
    if task.velocity is not None or task.mesh.n_nodes != len(known["basis"]):
        return False
    fingerprint = task_fingerprint(task)
    return fingerprint.shape == known["task"].shape and np.allclose(
        fingerprint, known["task"], atol=FINGERPRINT_ATOL)


# -- the network -----------------------------------------------------------------------------------


def gru_step(network: Network, inputs: np.ndarray, hidden_state: np.ndarray,
             direction: str = "") -> np.ndarray:
    """The new hidden state (h,) of a gated recurrent unit (Cho et al. 2014).

    ``inputs`` (d,) are raw; ``direction`` is ``"backward_"`` of the unit that reads from the end.
    """
    inputs = inputs / network["input_scale"]
    seen = network[f"{direction}input_weight"] @ inputs + network[f"{direction}input_bias"]
    kept = network[f"{direction}hidden_weight"] @ hidden_state + network[f"{direction}hidden_bias"]
    seen_reset, seen_keep, seen_new = np.split(seen, 3)
    kept_reset, kept_keep, kept_new = np.split(kept, 3)
    reset = _sigmoid(seen_reset + kept_reset)
    keep = _sigmoid(seen_keep + kept_keep)
    return (1.0 - keep) * np.tanh(seen_new + reset * kept_new) + keep * hidden_state


def network_output(network: Network, inputs: np.ndarray,
         hidden_state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The correction (q,) and its variance (q,): linear in the hidden state, or in those
    of both directions, and linear maps of the inputs (d,) that the hidden state mixes."""
    inputs = inputs / network["input_scale"]
    told = network["output_weight"] @ hidden_state + network["output_bias"]
    correction, log_variance = np.split(told, 2)
    mixed = network["mixing_weight"] @ hidden_state + network["mixing_bias"]
    correction = correction + mixed @ (network["maps"] @ inputs)
    scale = network["output_scale"]
    return scale * correction, scale**2 * np.exp(log_variance)


def initial_hidden_state(network: Network) -> np.ndarray:
    """(h,) the hidden state before anything is seen."""
    return np.zeros(network["hidden_weight"].shape[1])


def apply_correction(network: Network, c_ref: float, reduced: np.ndarray, inputs: np.ndarray,
              hidden_state: np.ndarray) -> Estimate:
    """ĉ_bh (1 + B (a + Δ)) of the modes a = ``reduced`` (q,), and its variance."""
    basis = network["basis"]
    correction, variance = network_output(network, inputs, hidden_state)
    mean = 1.0 + basis @ (reduced + correction)
    spread = basis**2 @ variance + network["rest"]
    return Estimate(c_ref * mean, c_ref**2 * spread)


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-x))


# -- what it sees ----------------------------------------------------------------------------------


class FilterFeatures:
    """What a network sees of an episode from the `InflowWindow`.

    Parameters
    ----------
    task : Task
    prior : InflowPrior
        Of the task's inlet.
    c_ref : float
        ĉ_bh in mol/m³.
    basis : (n, q)
        Modes of c/ĉ_bh − 1.
    lag : int
        The oldest state that is asked for, in steps before the present one.
    model : IdentifiedModel, optional
        With it, the filter is that of `baselines/identified_flow.py`.
    """

    def __init__(self, task: Task, prior: InflowPrior, c_ref: float, basis: np.ndarray,
                 lag: int = 0, model: IdentifiedModel | None = None) -> None:
        self.task = task
        self.reduce = np.linalg.pinv(basis)
        self.c_ref = c_ref
        self.filter = inflow_filter(task, prior, c_ref, lag, model=model,
                                    iterated=model is not None)

    def __call__(self, voltages: np.ndarray, currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Inputs (d,), and what the filter thinks after this measurement (q,): the innovation in
        parts of the noise, the filter's modes, what has changed in them, and which injection it
        is."""
        step = self.filter.assimilate(voltages, currents)
        before = self._modes(self.filter.space.concentration(step.predicted_mean))
        innovation = step.innovation
        after = self.modes()
        std = self.task.noise.std(voltages - innovation)
        return np.concatenate([np.arcsinh(innovation / std), after, after - before,
                               injection_one_hot(self.task, currents)]), after

    def modes(self, lag: int = 0) -> np.ndarray:
        """(q,) of the filter's mean, ``lag`` steps ago."""
        return self._modes(self.filter.space.concentration(self.filter.mean, lag))

    def _modes(self, concentration: np.ndarray) -> np.ndarray:
        return self.reduce @ (concentration / self.c_ref - 1.0)

    def record(self, record: Sequence[Measurement],
               *lags: int) -> tuple[np.ndarray, list[np.ndarray]]:
        """Of T measurements, (L,) in V and in A each: the inputs (T, d), and for each of ``lags``
        what the filter thinks of each state so many measurements later, or at the end (T, q)."""
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
    """What a network sees of an episode from voltages alone; parameters as of `FilterFeatures`."""

    def __init__(self, task: Task, c_ref: float, basis: np.ndarray) -> None:
        self.task = task
        homogeneous = np.full(task.mesh.n_nodes, c_ref)
        self.expected = task.observation.voltages(homogeneous, task.currents)
        self.none = np.zeros(basis.shape[1])

    def __call__(self, voltages: np.ndarray, currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Inputs (frame·L,), zero but for this injection's: where the voltages lie beside those of
        homogeneous fluid, in parts of the noise; and modes (q,) of homogeneous fluid, zero."""
        here = injection_one_hot(self.task, currents)
        expected = here @ self.expected
        off = (voltages - expected) / self.task.noise.std(expected)
        return np.outer(here, off).ravel(), self.none


# -- from the first measurement to the last --------------------------------------------------------


class NetworkCorrectedFilter:
    """Filter that a network corrects, for `FilterEstimator`.

    After the last measurement, when the lag shrinks, it returns the estimates of the filter alone.

    Parameters
    ----------
    network : mapping
        As `load_network` returns it.
    seen : FilterFeatures or VoltageFeatures
        Inputs of the network; `VoltageFeatures` has no lag.
    lag : int
        Of the task.
    """

    def __init__(self, network: Network, seen: FilterFeatures | VoltageFeatures, c_ref: float,
                 lag: int = 0) -> None:
        self.network = network
        self.seen = seen
        self.c_ref = c_ref
        self.lag = lag
        self._hidden_state = initial_hidden_state(network)
        self._measured = 0

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> None:
        """Show the network one more measurement, (L,) in V and in A."""
        inputs, reduced = self.seen(voltages, currents)
        self._measured += 1
        if self.lag and isinstance(self.seen, FilterFeatures):
            if self._measured <= self.lag:
                return
            reduced = self.seen.modes(self.lag)
            inputs = np.concatenate([inputs, reduced])
        self._hidden_state = gru_step(self.network, inputs, self._hidden_state)
        self._last = reduced, inputs

    def estimate(self, lag: int = 0) -> Estimate:
        """Return the state ``lag`` steps ago."""
        if lag < self.lag:
            assert isinstance(self.seen, FilterFeatures)
            return self.seen.filter.estimate(lag)
        return apply_correction(self.network, self.c_ref, *self._last, self._hidden_state)


def network_estimator(
        task: Task, network: Network,
        see: Callable[[float], FilterFeatures | VoltageFeatures]) -> FilterEstimator:
    """Return the estimator of a network; ``see`` maps ĉ_bh in mol/m³ to its inputs."""
    return FilterEstimator(task, lambda c_ref: NetworkCorrectedFilter(network, see(c_ref), c_ref,
                                                               task.lag))


def injection_one_hot(task: Task, currents: np.ndarray) -> np.ndarray:
    """(frame,) one for this injection of the task's cycle, zero for the others."""
    return (task.currents == currents).all(axis=1).astype(float)
