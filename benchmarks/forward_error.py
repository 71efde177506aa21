"""Discretisation error of the forward models in noise standard deviations: `python benchmarks/forward_error.py`.

Voltages of all 16 injections for states of training episodes, as they are on the truth's CD mesh, against an EIT
mesh of 68,000 unknowns. For the estimators' model the state is first taken at its own CD nodes, so its figure holds
all of its error: the coarser concentration, the interpolation, and the coarser EIT mesh.
"""

import numpy as np

from eitbench import simulate
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.physics.mesh import graded_pipe_mesh
from eitbench.physics.observation import ObservationModel
from eitbench.scenarios import Pipe2D
from eitbench.seeds import parse_seeds

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
    print(f"reference: {reference.cem.n_unknowns} unknowns, {len(errors['truth'])} states")
    for name, discretisation in (("truth", truth), ("model", model)):
        e = np.array(errors[name])
        print(f"{name}: {discretisation.observation.cem.n_unknowns} unknowns, "
              f"error rms {np.sqrt((e**2).mean()):.3f}, 99 % below {np.quantile(np.abs(e), 0.99):.3f}, "
              f"largest {np.abs(e).max():.3f} noise std")


if __name__ == "__main__":
    main()
