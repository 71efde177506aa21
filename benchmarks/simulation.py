"""Speed of simulating new episodes: `python benchmarks/run.py simulation`."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

import numpy as np
from common import Row, compare, quantity
from forward import system_matrix
from references import reference_flow
from solvers import refactorisations

from eitbench.data.episodes import cached_truth_model, simulate, simulate_batch
from eitbench.data.presimulation import cached_episode_bytes
from eitbench.physics.flow import PlaneChannelFlow
from eitbench.worlds.catalogue import PIPE_2D

BANK = 256


def rows() -> Iterator[Row]:
    transport, observation = cached_truth_model(PIPE_2D)
    cem = observation.cem
    n = transport.mesh.n_nodes
    n_steps = PIPE_2D.n_steps
    peers, _ = refactorisations(system_matrix(cem, np.full(cem.mesh.n_nodes, 0.3)))
    velocity = PlaneChannelFlow(PIPE_2D.flow.mean_velocity, PIPE_2D.vessel.half_width)
    flow = reference_flow(transport.mesh, velocity, PIPE_2D.flow.diffusivity, transport.time_step,
                          substeps=transport.substeps, inlet=transport.inlet)
    right = np.ones(n - len(transport.inlet))
    times = compare({**peers, "solve": lambda: flow._solver.factors.solve(right)}, 5)
    solve = times.pop("solve")
    name = min(times, key=lambda peer: times[peer])
    n_solves = (n_steps + PIPE_2D.spin_up_steps) * round(PIPE_2D.time_step
                                                   / transport.time_step) * (transport.substeps + 1)
    bare = n_steps * times[name] + n_solves * solve
    against = (f"{n_steps} bare refactorisations by {name}, {cem.n_unknowns:,} unknowns, "
               f"{quantity(times[name], 's')} "
               f"each, and {n_solves:,} bare solves by scipy's splu, {n:,} nodes, "
               f"{quantity(solve, 's')} each")
    alone = compare({"": lambda: simulate(PIPE_2D, 0, cache=False, progress=False)}, 3)[""]
    yield Row("simulation", f"a new episode, T = {n_steps}", against, alone, bare, "≤ 1.5×",
              "bytes: the flow's factors are read at every sub-step")
    begin = time.perf_counter()
    for _ in simulate_batch(PIPE_2D, range(8), progress=False):
        pass
    yield Row("simulation", "each of eight new episodes simulated together", "one alone",
              (time.perf_counter() - begin) / 8, alone, "",
              "flops and bytes; eight flows share what is read")
    one, two = (bank(jobs) for jobs in (1, 2))
    yield Row("simulation", f"`eitbench bank`, {BANK} episodes, two processes", "one process", two,
              one,
              "≥ 1.8× faster", "both cores; each process imports, and builds the truth's meshes",
              f"{quantity(two / BANK, 's')} and {cached_episode_bytes(PIPE_2D) / 1e6:.2f} MB "
              "an episode")


def bank(jobs: int) -> float:
    """Return the seconds of `eitbench bank` with an empty cache, including the start of Python."""
    with tempfile.TemporaryDirectory() as empty:
        begin = time.perf_counter()
        command = [sys.executable, "-m", "eitbench.cli", "bank", "--seeds",
                   f"train:0-{BANK - 1}", "-j", str(jobs)]
        subprocess.run(command, env=os.environ | {"EITBENCH_CACHE": empty}, check=True,
                       capture_output=True)
        return time.perf_counter() - begin
