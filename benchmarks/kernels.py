"""Speed of the compiled kernels relative to scipy: `python benchmarks/run.py kernels`.

The scipy implementation is in `references.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from common import Row, compare
from forward import conductivities, forget, pipe_mesh
from references import reference_flow, reference_model

from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.physics.flow import PlaneChannelFlow
from eitbench.physics.transport import ConvectionDiffusion
from eitbench.worlds.catalogue import PIPE_2D

CELLS = {"the estimators' model": (5, 14), "the truth": (10, 28)}
FLOWS = {"the estimators' model": (PIPE_2D.estimator_model, 1),
         "the truth": (PIPE_2D.truth_model, 8)}
VELOCITY = PlaneChannelFlow(PIPE_2D.flow.mean_velocity, PIPE_2D.vessel.half_width)


def rows() -> Iterator[Row]:
    for name, cells in CELLS.items():
        yield from electrode_models(name, cells)
    for name, (discretise, columns) in FLOWS.items():
        plain = discretise().transport
        flows = [kind(plain.mesh, VELOCITY, PIPE_2D.flow.diffusivity, plain.time_step,
                      substeps=plain.substeps, inlet=plain.inlet)
                 for kind in (ConvectionDiffusion, reference_flow)]
        c = np.random.default_rng(0).uniform(20.0, 40.0, (plain.mesh.n_nodes, columns))
        yield both(f"a step of {columns} flow{'s' * (columns > 1)}, {name}, "
                   f"{plain.mesh.n_nodes:,} nodes", flows, lambda cd, c=c: cd.step(c, 30.0, 31.0))
    identity = np.eye(1701)
    flows = [kind(PIPE_2D.estimator_model().transport.mesh, VELOCITY, PIPE_2D.flow.diffusivity,
                  PIPE_2D.time_step, inlet=np.arange(21))
             for kind in (ConvectionDiffusion, reference_flow)]
    yield both("F, column by column, 1,701 nodes", flows,
               lambda cd: cd.step(identity, identity[:21], 0.0), rounds=1)


def electrode_models(name: str, cells: tuple[int, int]) -> Iterator[Row]:
    mesh = pipe_mesh(*cells)
    sigma = conductivities(mesh, 16)
    models = [kind(mesh, PIPE_2D.vessel.electrodes(mesh), PIPE_2D.vessel.contact_impedance)
              for kind in (CompleteElectrodeModel, reference_model)]
    size = f"{name}, {models[0].n_unknowns:,} unknowns"
    yield both(f"𝓡(σ), {size}", models, lambda cem: forget(cem).transfer_resistance(sigma[0]))
    yield both(f"𝓡(σ) of 16 states, {size}", models, lambda cem: cem.transfer_resistance(sigma))
    yield both(f"𝓡 and its derivatives, {size}", models,
               lambda cem: forget(cem).transfer_resistance_derivatives(sigma[0]))


def both(what: str, models: list, work: Callable, rounds: int = 7) -> Row:
    """Compare the time of the compiled model with the reference, and check their results."""
    ours, scipy = (flat(work(model)) for model in models)
    np.testing.assert_allclose(ours, scipy, rtol=0.0, atol=1e-9 * np.abs(scipy).max())
    works = {"ours": lambda: work(models[0]), "scipy": lambda: work(models[1])}
    seconds = compare(works, rounds)
    return Row("kernels", what, "eitbench with scipy's SuperLU and sparse products",
               seconds["ours"], seconds["scipy"])


def flat(result) -> np.ndarray:
    """Concatenate all numbers of one or several arrays."""
    parts = result if isinstance(result, tuple) else (result,)
    return np.concatenate([np.ravel(part) for part in parts])
