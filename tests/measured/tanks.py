"""Simulated measurements: in a round tank, on a mesh that no estimator uses, and in an environment."""

from functools import cache

import numpy as np
from eitbench.measured import Measurements
from eitbench.worlds.vessels import RoundTank

VESSEL = {"kind": "circle", "radius": 0.1, "electrodes": 8, "cover": 0.4}
PIPE = {"kind": "rectangle", "length": 0.4, "width": 0.1, "electrodes": 16, "cover": 0.5}
CYLINDER = {"kind": "cylinder", "length": 0.2, "radius": 0.05, "rings": 2, "electrodes": 4, "height": 0.04,
            "cover": 0.5}
FIXED_STDS = {"initial_std": 0.2, "walk_std": 0.05}
"""Prior standard deviations that skip the slow maximisation of the evidence."""
SIGMA = 0.2
CONTACTS = 1e-3 * np.linspace(0.5, 2.0, 8)


def instrument(n_electrodes=8):
    """Return injections (K, L) in A and matrix (M, L) of adjacent electrodes."""
    pairs = np.eye(n_electrodes) - np.roll(np.eye(n_electrodes), 1, axis=1)
    return 1e-3 * pairs, pairs


TANK = RoundTank(radius=0.1, n_electrodes=8, electrode_coverage=0.4).electrode_model(True).with_contacts(CONTACTS)


@cache
def exact_homogeneous():
    """Return voltages (K, M) in V of homogeneous fluid without noise."""
    currents, matrix = instrument()
    return currents @ TANK.transfer_resistance(np.full(TANK.mesh.n_nodes, SIGMA)) @ matrix.T


def homogeneous(noise=0.0, frames=1, seed=0):
    """Return voltages (F, K, M) in V of homogeneous fluid with relative noise."""
    return exact_homogeneous() * (1.0 + noise * np.random.default_rng(seed).normal(size=(frames, 8, 8)))


@cache
def moving(frames=6, amplitude=2 / 3, bad_contact=1.0):
    """Simulate an inclusion with a third of the conductivity that moves half round the tank.

    The contact impedance of electrode 4 is multiplied by ``bad_contact``.
    """
    currents, matrix = instrument()
    model = TANK.with_contacts(CONTACTS * np.where(np.arange(8) == 3, bad_contact, 1.0))
    T = 8 * frames
    voltages = np.empty((T, 8))
    for t in range(T):
        R = model.transfer_resistance(conductivity(model.mesh.points, angle(t, T), amplitude))
        voltages[t] = currents[t % 8] @ R @ matrix.T
    voltages *= 1.0 + 1e-3 * np.random.default_rng(1).normal(size=voltages.shape)
    return Measurements(currents, np.arange(T) % 8, matrix, voltages, 0.01 * np.arange(T),
                        homogeneous(1e-3, 3), {"file": "moving"})


def stationary():
    """Simulate one frame of the inclusion at (5 cm, 0)."""
    currents, matrix = instrument()
    voltages = currents @ TANK.transfer_resistance(conductivity(TANK.mesh.points, 0.0)) @ matrix.T
    voltages *= 1.0 + 1e-3 * np.random.default_rng(5).normal(size=voltages.shape)
    return Measurements(currents, np.arange(8), matrix, voltages, 0.01 * np.arange(8), homogeneous(1e-3, 3),
                        {"file": "stationary"})


def angle(t, steps):
    """Return the angle of the inclusion in rad."""
    return np.pi * t / steps


def conductivity(points, angle, amplitude=2 / 3):
    """Return σ with a smooth inclusion halfway to the wall, lower by the fraction ``amplitude``."""
    centre = 0.05 * np.array([np.cos(angle), np.sin(angle)])
    distance = np.linalg.norm(points - centre, axis=1) / 0.025
    return SIGMA * (1.0 - amplitude * np.exp(-distance**2))


def centroid(points, estimate):
    """Return the centroid of the nodes whose deficit in ln c exceeds half of its maximum."""
    u = np.log(estimate)
    deficit = np.maximum(np.median(u) - u, 0.0)
    deficit[deficit < 0.5 * deficit.max()] = 0.0
    return deficit @ points / deficit.sum()


def simulate_measurements(env, seed):
    """Return currents and potentials of an episode of a simulated environment."""
    observation, _ = env.reset(seed=seed)
    T, L = env.episode_steps - env.lag, env.task.currents.shape[1]
    V, I = np.empty((2, T, L))
    for t in range(T):
        V[t], I[t] = observation["voltages"], observation["currents"]
        observation, *_ = env.step(np.zeros(env.action_space.shape))
    return Measurements.from_sequence(I, np.eye(L), V, env.task.transport.time_step * np.arange(1, T + 1),
                                      source={"file": "simulated"})
