"""Discretisation errors of voltages and of transport: `python studies/forward_error.py`.

Voltages of all 16 injections, for states of training episodes on the convection–diffusion (CD) mesh
of the truth, are compared with an EIT mesh of 68,000 unknowns. For the estimator model the state is
first interpolated to its CD nodes, so that its error includes the coarser concentration, the
interpolation, and the coarser EIT mesh. Voltage errors are relative to the noise std.

Transport: the model advects the true inlet values until its initial state has left the pipe. The
error is relative to the true deviation from the background.
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
from eitbench.worlds.catalogue import PIPE_2D
from eitbench.worlds.world import Discretisation, World

SEEDS, STATES = "train:0-3", range(20, 99, 6)


def main() -> None:
    world = PIPE_2D
    pipe = world.vessel
    truth, model = world.truth_model(), world.estimator_model()
    mesh = graded_pipe_mesh(pipe.length, pipe.half_width, pipe.electrode_spans, 24, 44)
    reference = ObservationModel(
        CompleteElectrodeModel(mesh, pipe.electrodes(mesh), pipe.contact_impedance),
        truth.transport.mesh.interpolation_to(mesh.points), truth.observation.conductivity, 0.01)
    to_model = truth.transport.mesh.interpolation_to(model.transport.mesh.points)
    errors: dict[str, list[np.ndarray]] = {"truth": [], "model": []}
    for seed in parse_seeds(SEEDS):
        for c in simulate(world, seed).concentration[list(STATES)].astype(float):
            exact = reference.voltages(c, world.currents)
            std = world.noise.std(exact)
            errors["truth"].append((truth.observation.voltages(c, world.currents) - exact) / std)
            errors["model"].append((model.observation.voltages(to_model @ c, world.currents)
                                    - exact) / std)
    transport = [_transport_error(world, model, to_model, simulate(world, seed).concentration)
                 for seed in parse_seeds(SEEDS)]
    print(f"transport: relative L2 error {np.mean(transport):.3f}, from {min(transport):.3f} to "
          f"{max(transport):.3f}")
    print(f"reference: {reference.cem.n_unknowns} unknowns, {len(errors['truth'])} states")
    for name, discretisation in (("truth", truth), ("model", model)):
        e = np.array(errors[name])
        print(f"{name}: {discretisation.observation.cem.n_unknowns} unknowns, "
              f"error rms {np.sqrt((e**2).mean()):.3f}, 99 % below "
              f"{np.quantile(np.abs(e), 0.99):.3f}, largest {np.abs(e).max():.3f} noise std")


def _transport_error(world: World, model: Discretisation, to_model: sp.csr_array,
                     truth: np.ndarray) -> float:
    transport = model.transport
    mass = mass_matrix(model.transport.mesh)
    exact = (to_model @ truth.astype(float).T).T
    c = exact[0]
    inlet = transport.inlet
    errors = []
    for before, after in itertools.pairwise(exact):
        c = transport.step(c, before[inlet], after[inlet])
        difference, deviation = c - after, after - world.background
        errors.append((difference @ mass @ difference) / (deviation @ mass @ deviation))
    return float(np.sqrt(np.mean(errors[3 * world.warm_up:])))


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
