"""Discretisation errors of voltages and of transport in 3D: `python studies/forward_error_3d.py`.

Like `forward_error.py`, for `Pipe3D`: EIT meshes with potentials of first and second order, and the
complete estimator model, are compared with a mesh of about 100,000 unknowns (2 GB, some minutes).
Voltage errors, for all 16 injections and states of a training episode, are relative to the noise
std.
"""

import time

import numpy as np
from forward_error import _transport_error
from threadpoolctl import threadpool_limits

from eitbench import simulate
from eitbench.numerics.round_meshes import round_pipe_mesh
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.physics.observation import ObservationModel
from eitbench.worlds.catalogue import PIPE_3D

REFERENCE = ((5, 6), 6, (2.5, 1.75, 2.5), 2)
MESHES = {"P1": ((3, 4), 6, (2.0, 1.5, 2.0), 1), "P1, finer": ((4, 6), 7, (2.0, 1.5, 2.0), 1),
          "P1, finest": ((5, 8), 9, (2.0, 1.5, 2.0), 1), "P2": ((2, 4), 4, (2.0, 1.5, 2.0), 2),
          "P2, the model's": ((3, 4), 4, (2.5, 1.5, 2.5), 2),
          "P2, the truth's": ((4, 5), 5, (2.5, 1.75, 2.5), 2)}
STATES = range(20, 66, 15)


def main() -> None:
    world = PIPE_3D
    pipe = world.vessel
    truth, model = world.truth_model(), world.estimator_model()
    concentration = simulate(world, 0).concentration.astype(float)
    states = concentration[list(STATES)]

    def observation(cells: tuple[int, int], rings: int, grading: tuple[float, float, float],
                    order: int) -> ObservationModel:
        mesh = round_pipe_mesh(pipe.length, pipe.radius, pipe.spans_around, pipe.spans_along, cells,
                               rings, grading)
        cem = CompleteElectrodeModel(mesh, pipe.electrodes(mesh), pipe.contact_impedance, order)
        return ObservationModel(cem, truth.transport.mesh.interpolation_to(mesh.points),
                                truth.observation.conductivity, 0.01)

    def voltages(model: ObservationModel, fields: np.ndarray) -> np.ndarray:
        return np.array([model.voltages(c, world.currents) for c in fields])

    reference = observation(*REFERENCE)
    exact = voltages(reference, states)
    std = world.noise.std(exact)
    print(f"reference: {reference.cem.n_unknowns:,} unknowns, {len(states)} states")
    print("| mesh | EIT unknowns | s per state | error rms | 99 % below | largest "
          "|\n|---|---|---|---|---|---|")

    def row(name: str, model: ObservationModel, fields: np.ndarray) -> None:
        model.transfer_resistance(fields[:1])                       # compiles, allocates memory
        start = time.perf_counter()
        model.transfer_resistance(fields)
        seconds = (time.perf_counter() - start) / len(fields)
        e = np.abs((voltages(model, fields) - exact) / std)
        print(f"| {name} | {model.cem.n_unknowns:,} | {seconds:.3f} | "
              f"{np.sqrt((e**2).mean()):.2f} | "
              f"{np.quantile(e, 0.99):.2f} | {e.max():.2f} |", flush=True)

    for name, specification in MESHES.items():
        row(name, observation(*specification), states)
    to_model = truth.transport.mesh.interpolation_to(model.transport.mesh.points)
    row("the model with its coarser concentration", model.observation, (to_model @ states.T).T)
    print("transport: relative L2 error "
          f"{_transport_error(world, model, to_model, concentration):.3f}")


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
