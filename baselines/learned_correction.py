"""Recurrent network that corrects the log-inflow filter: learned from training episodes in which
the fluid flows faster or slower than the model says.

A GRU (Cho et al. 2014) sees how each measurement compares with the filter's prediction, and what
the filter thinks before and after it, in the modes of training concentrations. It says in these
modes by how much the filter is off, and with which variance. `studies/learn_correction.py` trains
it; here it needs numpy alone, and the network, which is in a checkout only.
"""

from functools import lru_cache
from pathlib import Path

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import FirstFrame, InflowFilter, suiting_priors

HERE = Path(__file__).parent
NETWORK = "networks/pipe2d-biased.npz"


class Estimator:
    boards = ("filter",)
    parameters = {"network": NETWORK}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        self.task = task
        self.first = FirstFrame(task)
        self.network = load(HERE / NETWORK)
        self.memory = np.zeros(len(self.network["hidden_bias"]) // 3)

    @staticmethod
    def suits(task: Task) -> bool:
        """Only the task that it was trained for: that vessel, those injections, that model of the
        flow."""
        known_inlet = bool(suiting_priors(HERE / "priors", task, "logarithm"))
        if task.velocity is not None or not known_inlet or not (HERE / NETWORK).is_file():
            return False
        known = load(HERE / NETWORK)
        if task.mesh.n_nodes != len(known["basis"]):
            return False
        there = fingerprint(task)
        return there.shape == known["task"].shape and np.allclose(there, known["task"], atol=1e-4)

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate:
        if not self.first.complete:
            if not self.first.add(voltages, currents):
                return Estimate(self.first.mean)
            self.features = Features(self.task, self.first.c_bh, self.network["basis"])
            for earlier in self.first.measurements[:-1]:
                self.think(*earlier)
        return self.think(voltages, currents)

    def think(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate:
        basis = self.network["basis"]
        inputs, reduced = self.features(voltages, currents)
        self.memory, correction, variance = step(self.network, inputs, self.memory)
        mean = 1.0 + basis @ (reduced + correction)
        spread = basis**2 @ variance + self.network["rest"]
        return Estimate(self.first.c_bh * mean, self.first.c_bh**2 * spread)


class Features:
    """What the network sees of an episode: from the filter, step by step.

    Parameters
    ----------
    task : Task
    level : float
        ĉ_bh in mol/m³.
    basis : (n, q)
        Modes of c/ĉ_bh − 1.
    """

    def __init__(self, task: Task, level: float, basis: np.ndarray) -> None:
        self.task = task
        self.reduce = np.linalg.pinv(basis)
        self.filter = InflowFilter(task, suiting_priors(HERE / "priors", task, "logarithm")[0],
                                   level)

    def __call__(self, voltages: np.ndarray, currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Inputs, and what the filter thinks after this measurement (q,)."""
        self.filter.predict()
        before = self.modes()
        innovation = self.filter.update(voltages, currents).value
        after = self.modes()
        std = self.task.noise.std(voltages - innovation)
        pattern = (self.task.currents == currents).all(axis=1)
        return np.concatenate([np.arcsinh(innovation / std), after, after - before, pattern]), after

    def modes(self) -> np.ndarray:
        """(q,) of the filter's mean."""
        return self.reduce @ (self.filter.concentration() / self.filter.level - 1.0)


def step(network: dict[str, np.ndarray], inputs: np.ndarray,
         memory: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The new memory (h,), the correction (q,) and its variance (q,): a GRU, a linear layer, and
    linear maps of the inputs that the memory mixes, as the flow's velocity would."""
    inputs = inputs / network["input_scale"]
    seen = np.split(network["input_weight"] @ inputs + network["input_bias"], 3)
    kept = np.split(network["hidden_weight"] @ memory + network["hidden_bias"], 3)
    reset = sigmoid(seen[0] + kept[0])
    keep = sigmoid(seen[1] + kept[1])
    memory = (1.0 - keep) * np.tanh(seen[2] + reset * kept[2]) + keep * memory
    said = network["output_weight"] @ memory + network["output_bias"]
    correction, log_variance = np.split(said, 2)
    mixed = network["mixing_weight"] @ memory + network["mixing_bias"]
    correction = correction + mixed @ (network["maps"] @ inputs)
    scale = network["output_scale"]
    return memory, scale * correction, scale**2 * np.exp(log_variance)


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-x))


def fingerprint(task: Task) -> np.ndarray:
    """Voltages of a homogeneous vessel, and where one time step carries a blob: what a task looks
    like to the network."""
    level = task.expected_concentration
    x = task.mesh.points
    blob = np.exp(-0.5 * ((x - x.mean(axis=0))**2).sum(axis=1) / 0.02**2)
    still = np.zeros(len(task.transport.inlet))
    moved = task.transport.step(blob, still, still)
    voltages = task.observation.voltages(np.full(len(x), level), task.currents)
    return np.concatenate([voltages.ravel() / np.abs(voltages).max(), moved @ x / moved.sum()])


@lru_cache(maxsize=2)
def load(path: Path) -> dict[str, np.ndarray]:
    """The network's arrays, in double precision."""
    with np.load(path) as file:
        return {name: file[name].astype(float) for name in file.files}
