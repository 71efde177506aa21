"""Errors of the truth's voltages of moving bodies: `python studies/body_mesh.py`, seven minutes.

Voltages of all 120 pairs, for a body at places of training episodes, are compared with a mesh that
is fitted to the body: rings of nodes around its centre, 0.3 mm apart at its edge. The first row
has the body of the truth, whose edge is smooth, so that the difference is the error of the truth's
mesh. The second row has a body with a sharp edge in the fitted mesh, and measures the smoothness.
Errors are in standard deviations of the noise, of the electrodes that are measured.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay
from threadpoolctl import threadpool_limits

from eitbench.estimation.body_particles import body_model
from eitbench.estimation.onboard.rules import Rules
from eitbench.numerics.mesh import Mesh
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.worlds import entry
from eitbench.worlds.bodies import TRANSITION_WIDTH, disc_indicator
from eitbench.worlds.random_streams import episode_streams
from eitbench.worlds.task import make_task
from eitbench.worlds.world import World

WORLDS = ("TankTracking", "BubbleTracking")
N_STATES = 8
SPACING = 3e-4
"""m, between rings of the fitted mesh at the edge"""
SHARP = 2e-5
"""m, transition of the sharp edge"""


def fitted_mesh(mesh: Mesh, centre: np.ndarray, radius: float, edge: float) -> Mesh:
    """Return a triangulation of the nodes of ``mesh`` of a convex vessel, with rings around a disc
    in place of its nodes near the disc; ``edge`` is the transition in m, `SHARP` or wider."""
    wall = mesh.points[np.unique(mesh.boundary_facets)]
    radii = np.concatenate([np.arange(radius, 0.2 * radius, -SPACING)[::-1],
                            np.arange(radius, radius + 2.5 * TRANSITION_WIDTH, SPACING)[1:]])
    if edge == SHARP:
        radii = np.concatenate([radii[radii != radius], radius + np.array([-SHARP, SHARP])])
    angles = np.linspace(0.0, 2.0 * np.pi, int(2.0 * np.pi * radius / SPACING), endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    ring_nodes = np.concatenate([[centre], *(centre + r * circle for r in radii)])
    to_wall = np.array([np.hypot(*(wall - node).T).min() for node in ring_nodes])
    inside = Delaunay(wall).find_simplex(ring_nodes) >= 0
    ring_nodes = ring_nodes[inside & (to_wall > SPACING)]
    distance = np.hypot(*(mesh.points - centre).T)
    is_wall = np.isin(np.arange(mesh.n_nodes), mesh.boundary_facets)
    points = np.concatenate([mesh.points[is_wall | (distance > radii.max() + SPACING)], ring_nodes])
    cells = Delaunay(points).simplices
    edges = points[cells[:, 1:]] - points[cells[:, :1]]
    return Mesh(points, cells[np.abs(np.linalg.det(edges)) > 1e-3 * SPACING**2])


def errors(world: World, truth: CompleteElectrodeModel, finer: Mesh,
           seed: int) -> dict[str, np.ndarray]:
    """Return the RMS error of the measured voltages of each pair, in noise std, at a random time
    of an episode at which the body is present."""
    path = world.target.path(world, episode_streams(seed).flow)
    t = np.random.default_rng(seed).choice(np.flatnonzero(path.present))
    currents = Rules(world).action_currents
    std = world.noise.std(currents @ body_model(make_task(world)).resistance)
    std[~world.instrument.measurement_mask(currents)] = np.nan
    target, vessel = world.target, world.vessel

    def voltages(cem: CompleteElectrodeModel, points: np.ndarray, edge: float) -> np.ndarray:
        disc = disc_indicator(points, path.centres[t], path.radius, edge)
        c = target.background + (target.concentration - target.background) * disc
        return currents @ cem.transfer_resistance(vessel.molar_conductivity * c)

    found = voltages(truth, truth.mesh.points, TRANSITION_WIDTH)
    rows = {}
    for name, edge in (("the mesh of the truth", TRANSITION_WIDTH), ("the smooth edge", SHARP)):
        mesh = fitted_mesh(finer, path.centres[t], path.radius, edge)
        cem = CompleteElectrodeModel(mesh, vessel.electrodes(mesh), vessel.contact_impedance)
        rows[name] = np.sqrt(np.nanmean(
            ((found - voltages(cem, mesh.points, edge)) / std)**2, axis=1))
    return rows


def main() -> None:
    print("| world | effect of | median of the pairs | 90 % below | largest |\n|---|---|"
          + "---:|" * 3)
    for name in WORLDS:
        world = entry(f"eitbench/{name}-v0").world
        truth = world.truth_model().observation.cem
        finer = world.with_changes({"vessel": {"truth_refinement": 3}}).truth_model()
        rows = [errors(world, truth, finer.observation.cem.mesh, seed) for seed in range(N_STATES)]
        for effect in rows[0]:
            e = np.concatenate([row[effect] for row in rows])
            print(f"| {name} | {effect} | {np.median(e):.2f} | {np.quantile(e, 0.9):.2f} | "
                  f"{e.max():.2f} |", flush=True)


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
