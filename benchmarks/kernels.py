"""What the compiled kernels buy: the same work with numba and with scipy, `python benchmarks/run.py kernels`."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from common import Row, compare
from forward import conductivities, pipe_mesh

from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.physics.flow import PlaneChannelFlow
from eitbench.physics.transport import ConvectionDiffusion
from eitbench.worlds import Pipe2D

SCENARIO = Pipe2D()
BACKENDS = ("compiled", "scipy")
CELLS = {"the estimators' model": (5, 14), "the truth": (10, 28)}
FLOWS = {"the estimators' model": (SCENARIO.model, 1), "the truth": (SCENARIO.truth, 8)}


def rows() -> Iterator[Row]:
    for name, cells in CELLS.items():
        mesh = pipe_mesh(*cells)
        sigma = conductivities(mesh, 16)
        models = {backend: CompleteElectrodeModel(mesh, SCENARIO.electrodes(mesh), SCENARIO.contact_impedance,
                                                  backend=backend) for backend in BACKENDS}
        size = f"{name}, {models['scipy'].n_unknowns:,} unknowns"
        for what, work in (("𝓡(σ)", lambda cem, sigma=sigma: cem.transfer_resistance(sigma[0])),
                           ("𝓡(σ) of 16 states", lambda cem, sigma=sigma: cem.transfer_resistance(sigma)),
                           ("𝓡 and its derivatives", lambda cem, sigma=sigma: cem.transfer_resistance_derivatives(
                               sigma[0]))):
            yield both(f"{what}, {size}", {b: lambda cem=cem, work=work: work(cem) for b, cem in models.items()})
    for name, (discretise, columns) in FLOWS.items():
        plain = discretise().transport
        flows = {backend: ConvectionDiffusion(
            plain.mesh, PlaneChannelFlow(SCENARIO.mean_velocity, SCENARIO.half_width), SCENARIO.diffusivity,
            plain.time_step, substeps=plain.substeps, inlet=plain.inlet, backend=backend) for backend in BACKENDS}
        c = np.random.default_rng(0).uniform(20.0, 40.0, (plain.mesh.n_nodes, columns))
        yield both(f"a step of {columns} flow{'s' * (columns > 1)}, {name}, {plain.mesh.n_nodes:,} nodes",
                   {b: lambda cd=cd, c=c: cd.step(c, 30.0, 31.0) for b, cd in flows.items()})
    identity = np.eye(1701)
    flows = {backend: ConvectionDiffusion(
        SCENARIO.model().transport.mesh, PlaneChannelFlow(SCENARIO.mean_velocity, SCENARIO.half_width),
        SCENARIO.diffusivity, SCENARIO.time_step, inlet=np.arange(21), backend=backend) for backend in BACKENDS}
    yield both("F, column by column, 1,701 nodes",
               {b: lambda cd=cd: cd.step(identity, identity[:21], 0.0) for b, cd in flows.items()}, rounds=1)


def both(what: str, works: dict, rounds: int = 7) -> Row:
    """The kernels against what they replace."""
    results = [np.concatenate([np.ravel(part) for part in (got if isinstance(got, tuple) else (got,))])
               for got in (work() for work in works.values())]
    np.testing.assert_allclose(*results, rtol=0.0, atol=1e-9 * np.abs(results[1]).max())
    seconds = compare(works, rounds)
    return Row("kernels", what, "ours with scipy's SuperLU and sparse products", seconds["compiled"], seconds["scipy"])
