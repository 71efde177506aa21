"""From which part of its extreme on a pixel is a body's: `python studies/segment.py`, six minutes.

Simulates tanks like those of the Kuopio Tomography Challenge (23 cm, 32 electrodes), with bodies
that conduct 50 times better or 1000 times worse, on a mesh that no estimator has, estimates them
with log_map, and prints the challenge's score of each rule. What scores best on the first twelve
tanks, and of equals what claims least, is what `eitbench.measured.segmentation` does; twelve others
show what that is worth.
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
from eitbench.numerics.round import electrode_disc
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.worlds.vessels import RoundTank

RADIUS, COUNT, COVER = 0.115, 32, 0.5
VESSEL = {"kind": "circle", "radius": RADIUS, "electrodes": COUNT, "cover": COVER}
SIGMA = 0.15
"""S/m of the water; a plane model: A are A per m of depth"""
RATIOS = {RESISTIVE: 1e-3, CONDUCTIVE: 50.0}
NOISE = 1e-3
"""of a reading, and of the largest one a hundredth of that"""
TANKS = 12
PARTS = (0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.6)
LEASTS = (0.25, 0.5, 1.0, 1.5)


class Body(NamedTuple):
    """A disk or a polygon."""

    middle: np.ndarray
    corners: int
    radius: float
    turned: float
    kind: int

    def holds(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Whether points in m are in it; a regular polygon, of 0 corners a disk."""
        x, y = x - self.middle[0], y - self.middle[1]
        far = np.hypot(x, y)
        if not self.corners:
            return far < self.radius
        sector = 2.0 * np.pi / self.corners
        angle = (np.arctan2(y, x) - self.turned) % sector - 0.5 * sector
        return far * np.cos(angle) < self.radius * np.cos(0.5 * sector)


def main() -> None:
    tanks = Parallel(n_jobs=2, return_as="generator")(delayed(scores)(seed)
                                                      for seed in range(2 * TANKS))
    found = np.array(list(tqdm(tanks, total=2 * TANKS, unit="tank", disable=None)))
    chosen = found[:TANKS].mean(axis=0)
    print("mean score of the first tanks: parts down, least extremes across", LEASTS)
    for part, row in zip(PARTS, chosen, strict=True):
        print(f"{part:.2f}  " + "  ".join(f"{score:.3f}" for score in row))
    i, j = np.argwhere(chosen == chosen.max())[-1]      # of equals the one that claims least
    others = found[TANKS:, i, j]
    print(f"best: part {PARTS[i]}, least {LEASTS[j]}: {chosen[i, j]:.3f}; on the others "
          f"{others.mean():.3f} ± {2 * others.std(ddof=1) / TANKS**0.5:.3f}")


def scores(seed: int) -> np.ndarray:
    """(parts, leasts) of one tank."""
    bodies = drawn(seed)
    env = MeasuredEnv(record(bodies, seed), VESSEL)
    estimate = run_on_measurements(env, "log_map").mean[-1]
    truth = picture(bodies)
    return np.array([[ktc_score(truth, segment(env.vessel, env.task, estimate, part, least))
                      for least in LEASTS] for part in PARTS])


def drawn(seed: int) -> list[Body]:
    """One to three bodies that do not touch each other or the wall."""
    random = np.random.default_rng([seed, 2023])
    bodies: list[Body] = []
    count = random.integers(1, 4)
    while len(bodies) < count:
        radius = random.uniform(0.015, 0.035)
        far = (RADIUS - radius - 0.01) * np.sqrt(random.uniform())
        angle = random.uniform(0.0, 2.0 * np.pi)
        body = Body(far * np.array([np.cos(angle), np.sin(angle)]), random.choice([0, 3, 4]),
                    radius, random.uniform(0.0, np.pi), random.choice([RESISTIVE, CONDUCTIVE]))
        if all(np.hypot(*(body.middle - other.middle)) > body.radius + other.radius + 0.01
               for other in bodies):
            bodies.append(body)
    return bodies


def picture(bodies: list[Body]) -> np.ndarray:
    """The truth, pixel by pixel."""
    side = ((np.arange(PIXELS) + 0.5) / PIXELS * 2.0 - 1.0) * RADIUS
    x, y = np.meshgrid(side, -side)
    classes = np.full(x.shape, WATER)
    for body in bodies:
        classes[body.holds(x, y)] = body.kind
    return classes


def record(bodies: list[Body], seed: int) -> Measurements:
    """Neighbours, and pairs across, injected; 31 differences of neighbours read."""
    tank = RoundTank(RADIUS, COUNT, COVER)
    mesh = electrode_disc(RADIUS, tank.electrode_spans, 10, 34)
    contacts = 1e-4 * (1.0 + np.arange(COUNT) / COUNT)
    model = CompleteElectrodeModel(mesh, tank.electrodes(mesh), contacts)
    each = np.eye(COUNT)
    currents = np.vstack([each - np.roll(each, 1, axis=1), (each - np.roll(each, 16, axis=1))[:16],
                          (each - np.roll(each, 8, axis=1))])
    currents *= 2e-3
    matrix = (each - np.roll(each, 1, axis=1))[:31]
    x, y = mesh.points.T
    conductivity = np.full(len(x), SIGMA)
    for body in bodies:
        conductivity[body.holds(x, y)] = RATIOS[body.kind] * SIGMA
    random = np.random.default_rng([seed, 1])
    readings = [currents @ model.transfer_resistance(sigma) @ matrix.T
                for sigma in (np.full(len(x), SIGMA), conductivity)]
    empty, full = (exact + NOISE * (np.abs(exact) + 0.01 * np.abs(exact).max())
                   * random.normal(size=exact.shape) for exact in readings)
    K = len(currents)
    return Measurements(currents, np.arange(K), matrix, full, np.arange(float(K)), empty[None],
                        {"file": f"tank {seed}"})


if __name__ == "__main__":
    print(Path(__file__).name, "simulates", 2 * TANKS, "tanks")
    main()
