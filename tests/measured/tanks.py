"""Records that a simulated instrument took of a round tank, on a mesh of its own."""

import numpy as np
from eitbench.data.measured import Measurements
from eitbench.worlds.vessels import RoundTank

VESSEL = {"kind": "circle", "radius": 0.1, "electrodes": 8, "cover": 0.4}
SIGMA = 0.2
CONTACTS = 1e-3 * np.linspace(0.5, 2.0, 8)


def instrument(n_electrodes=8):
    """Its injections (K, L), in A, and matrix (M, L): neighbours, as most have."""
    pairs = np.eye(n_electrodes) - np.roll(np.eye(n_electrodes), 1, axis=1)
    return 1e-3 * pairs, pairs


def homogeneous(noise=0.0, records=1, seed=0):
    """Readings (F, K, M) of homogeneous fluid."""
    currents, matrix = instrument()
    electrodes = RoundTank(radius=0.1, n_electrodes=8, electrode_cover=0.4).electrode_model(True)
    model = electrodes.with_contacts(CONTACTS)
    exact = currents @ model.transfer_resistance(np.full(model.mesh.n_nodes, SIGMA)) @ matrix.T
    return exact * (1.0 + noise * np.random.default_rng(seed).normal(size=(records, 8, 8)))


def moving(frames=6, noise=1e-3, seed=1, records=3, amplitude=2 / 3, contacts=CONTACTS):
    """A record of a body that conducts a third, on its way half round the tank."""
    currents, matrix = instrument()
    model = RoundTank(radius=0.1, n_electrodes=8, electrode_cover=0.4).electrode_model(True)
    model = model.with_contacts(contacts)
    T = 8 * frames
    readings = np.empty((T, 8))
    for t in range(T):
        R = model.transfer_resistance(conductivity(model.mesh.points, angle(t, T), amplitude))
        readings[t] = currents[t % 8] @ R @ matrix.T
    readings *= 1.0 + noise * np.random.default_rng(seed).normal(size=readings.shape)
    return Measurements(currents, np.arange(T) % 8, matrix, readings, 0.01 * np.arange(T),
                        homogeneous(noise, records), {"file": "moving"})


def angle(t, steps):
    """Where the body is, in rad."""
    return np.pi * t / steps


def conductivity(points, angle, amplitude=2 / 3):
    """Of a smooth body half way to the wall, which conducts less by this part."""
    centre = 0.05 * np.array([np.cos(angle), np.sin(angle)])
    far = np.linalg.norm(points - centre, axis=1) / 0.025
    return SIGMA * (1.0 - amplitude * np.exp(-far**2))
