"""Choose the thresholds of the segmentation: `python studies/segment.py`, six minutes.

Simulates tanks of the Kuopio Tomography Challenge (23 cm, 32 electrodes), with bodies that conduct
50 times better or 1000 times worse, on another mesh than the estimator model, estimates them with
log_map, and prints the challenge's score for each pair of thresholds. The module
`eitbench.measured.segmentation` uses the pair with the best score on the first twelve tanks, and of
equal pairs the most restrictive one. Twelve other tanks test it.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from joblib import Parallel, delayed
from tqdm import tqdm

from eitbench.bench.runner import run_on_measurements
from eitbench.envs.measured import MeasuredEnv
from eitbench.measured import Measurements
from eitbench.measured.segmentation import (
    CONDUCTIVE,
    PIXELS,
    RESISTIVE,
    WATER,
    ktc_score,
    segment,
)
from eitbench.numerics.round_meshes import electrode_disc
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.worlds.vessels import RoundTank

RADIUS, COUNT, COVER = 0.115, 32, 0.5
VESSEL = {"kind": "circle", "radius": RADIUS, "electrodes": COUNT, "cover": COVER}
SIGMA = 0.15
"""S/m of the water; in this plane model currents are in A per m of depth"""
RATIOS = {RESISTIVE: 1e-3, CONDUCTIVE: 50.0}
NOISE = 1e-3
"""relative to a measurement, and a hundredth of it relative to the largest measurement"""
TANKS = 12
EXTREME_FRACTIONS = (0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.6)
MIN_LOG_CONTRASTS = (0.25, 0.5, 1.0, 1.5)


class Body(NamedTuple):
    """A disk (0 corners) or a regular polygon."""

    centre: np.ndarray
    corners: int
    radius: float
    rotation: float
    kind: int

    def contains(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return True for points in m inside the body."""
        x, y = x - self.centre[0], y - self.centre[1]
        r = np.hypot(x, y)
        if not self.corners:
            return r < self.radius
        sector = 2.0 * np.pi / self.corners
        angle = (np.arctan2(y, x) - self.rotation) % sector - 0.5 * sector
        return r * np.cos(angle) < self.radius * np.cos(0.5 * sector)


def main() -> None:
    tanks = Parallel(n_jobs=2, return_as="generator")(delayed(tank_scores)(seed)
                                                      for seed in range(2 * TANKS))
    scores = np.array(list(tqdm(tanks, total=2 * TANKS, unit="tank", disable=None)))
    mean = scores[:TANKS].mean(axis=0)
    print("mean score of the first tanks; rows: fractions of the extreme; columns: minimum log "
          "contrasts", MIN_LOG_CONTRASTS)
    for fraction, row in zip(EXTREME_FRACTIONS, mean, strict=True):
        print(f"{fraction:.2f}  " + "  ".join(f"{score:.3f}" for score in row))
    i, j = np.argwhere(mean == mean.max())[-1]      # the most restrictive of equal pairs
    others = scores[TANKS:, i, j]
    print(f"best: {EXTREME_FRACTIONS[i]}, {MIN_LOG_CONTRASTS[j]}: {mean[i, j]:.3f}; other tanks "
          f"{others.mean():.3f} ± {2 * others.std(ddof=1) / TANKS**0.5:.3f}")


def tank_scores(seed: int) -> np.ndarray:
    """Return the scores of one tank for each pair of thresholds."""
    bodies = sample_bodies(seed)
    env = MeasuredEnv(measure(bodies, seed), VESSEL)
    estimate = run_on_measurements(env, "log_map").mean[-1]
    truth = true_classes(bodies)
    return np.array([[ktc_score(truth, segment(env.vessel, env.task, estimate, fraction, contrast))
                      for contrast in MIN_LOG_CONTRASTS] for fraction in EXTREME_FRACTIONS])


def sample_bodies(seed: int) -> list[Body]:
    """Sample one to three bodies that do not touch each other or the wall."""
    random = np.random.default_rng([seed, 2023])
    bodies: list[Body] = []
    count = random.integers(1, 4)
    while len(bodies) < count:
        radius = random.uniform(0.015, 0.035)
        distance = (RADIUS - radius - 0.01) * np.sqrt(random.uniform())
        angle = random.uniform(0.0, 2.0 * np.pi)
        body = Body(distance * np.array([np.cos(angle), np.sin(angle)]), random.choice([0, 3, 4]),
                    radius, random.uniform(0.0, np.pi), random.choice([RESISTIVE, CONDUCTIVE]))
        if all(np.hypot(*(body.centre - other.centre)) > body.radius + other.radius + 0.01
               for other in bodies):
            bodies.append(body)
    return bodies


def true_classes(bodies: list[Body]) -> np.ndarray:
    """Return the true class of each pixel."""
    side = ((np.arange(PIXELS) + 0.5) / PIXELS * 2.0 - 1.0) * RADIUS
    x, y = np.meshgrid(side, -side)
    classes = np.full(x.shape, WATER)
    for body in bodies:
        classes[body.contains(x, y)] = body.kind
    return classes


def measure(bodies: list[Body], seed: int) -> Measurements:
    """Simulate 31 adjacent voltage differences for adjacent, opposite and quarter-turn pairs."""
    tank = RoundTank(RADIUS, COUNT, COVER)
    mesh = electrode_disc(RADIUS, tank.electrode_spans, 10, 34)
    contacts = 1e-4 * (1.0 + np.arange(COUNT) / COUNT)
    model = CompleteElectrodeModel(mesh, tank.electrodes(mesh), contacts)
    eye = np.eye(COUNT)
    currents = np.vstack([eye - np.roll(eye, 1, axis=1), (eye - np.roll(eye, 16, axis=1))[:16],
                          (eye - np.roll(eye, 8, axis=1))])
    currents *= 2e-3
    matrix = (eye - np.roll(eye, 1, axis=1))[:31]
    x, y = mesh.points.T
    conductivity = np.full(len(x), SIGMA)
    for body in bodies:
        conductivity[body.contains(x, y)] = RATIOS[body.kind] * SIGMA
    random = np.random.default_rng([seed, 1])
    voltages = [currents @ model.transfer_resistance(sigma) @ matrix.T
                for sigma in (np.full(len(x), SIGMA), conductivity)]
    empty, full = (exact + NOISE * (np.abs(exact) + 0.01 * np.abs(exact).max())
                   * random.normal(size=exact.shape) for exact in voltages)
    K = len(currents)
    return Measurements(currents, np.arange(K), matrix, full, np.arange(float(K)), empty[None],
                        {"file": f"tank {seed}"})


if __name__ == "__main__":
    print(Path(__file__).name, "simulates", 2 * TANKS, "tanks")
    main()
