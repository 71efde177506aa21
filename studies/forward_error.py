"""Discretisation errors, of voltages and of transport: `python benchmarks/forward_error.py`.

Voltages of all 16 injections for states of training episodes, as they are on the truth's CD mesh, against an EIT
mesh of 68,000 unknowns. For the estimators' model the state is first taken at its own CD nodes, so its figure holds
all of its error: the coarser concentration, the interpolation, and the coarser EIT mesh. Voltage errors are in noise
standard deviations.

Transport: the model carries the true inlet values through the pipe until it has forgotten where it began; its error is
relative to the true deviation from the background.
"""

import itertools

import numpy as np
import scipy.sparse as sp
from threadpoolctl import threadpool_limits

from eitbench import simulate
from eitbench.data.seeds import parse_seeds
from eitbench.numerics.fem import mass_matrix
from eitbench.numerics.mesh import graded_pipe_mesh
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.physics.observation import ObservationModel
from eitbench.worlds import Pipe2D
from eitbench.worlds.base import Discretisation

SEEDS, STATES = "train:0-3", range(20, 99, 6)


def main() -> None:
    scenario = Pipe2D()
    truth, model = scenario.truth(), scenario.model()
    mesh = graded_pipe_mesh(scenario.length, scenario.half_width, scenario.electrode_spans, 24, 44)
    reference = ObservationModel(
        CompleteElectrodeModel(mesh, scenario.electrodes(mesh), scenario.contact_impedance),
        truth.transport.mesh.interpolation_to(mesh.points), truth.observation.conductivity, 0.01)
    to_model = truth.transport.mesh.interpolation_to(model.transport.mesh.points)
    errors: dict[str, list[np.ndarray]] = {"truth": [], "model": []}
    for seed in parse_seeds(SEEDS):
        for c in simulate(scenario, seed).concentration[list(STATES)].astype(float):
            exact = reference.voltages(c, scenario.currents)
            std = scenario.noise.std(exact)
            errors["truth"].append((truth.observation.voltages(c, scenario.currents) - exact) / std)
            errors["model"].append((model.observation.voltages(to_model @ c, scenario.currents) - exact) / std)
    transport = [_transport_error(scenario, model, to_model, simulate(scenario, seed).concentration)
                 for seed in parse_seeds(SEEDS)]
    print(f"transport: relative L2 error {np.mean(transport):.3f}, from {min(transport):.3f} to {max(transport):.3f}")
    print(f"reference: {reference.cem.n_unknowns} unknowns, {len(errors['truth'])} states")
    for name, discretisation in (("truth", truth), ("model", model)):
        e = np.array(errors[name])
        print(f"{name}: {discretisation.observation.cem.n_unknowns} unknowns, "
              f"error rms {np.sqrt((e**2).mean()):.3f}, 99 % below {np.quantile(np.abs(e), 0.99):.3f}, "
              f"largest {np.abs(e).max():.3f} noise std")


def _transport_error(scenario: Pipe2D, model: Discretisation, to_model: sp.csr_array, truth: np.ndarray) -> float:
    transport, mass = model.transport, mass_matrix(model.transport.mesh)
    exact = (to_model @ truth.astype(float).T).T
    c, inlet = exact[0], transport.inlet
    errors = []
    for before, after in itertools.pairwise(exact):
        c = transport.step(c, before[inlet], after[inlet])
        difference, deviation = c - after, after - scenario.background
        errors.append((difference @ mass @ difference) / (deviation @ mass @ deviation))
    return float(np.sqrt(np.mean(errors[3 * scenario.warm_up:])))


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
