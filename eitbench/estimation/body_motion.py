"""Motion of a body's particles, and the grid on which its signals and images are tabulated."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from eitbench.worlds.bodies import RisingBubble, reflect
from eitbench.worlds.task import Task

SPACING = 5e-3
"""m, spacing of the grid on which signals and images of a body are tabulated."""


class TankMotion:
    """Ornstein–Uhlenbeck velocities in a round tank, with the speed and the run time of the body.

    Attributes
    ----------
    shape, origin : tuple
        Columns and rows of the grid; column and row of the point (0, 0).
    mean_velocity, velocity_std, decay : (2,) arrays
        Mean and standard deviation of the velocity relative to the liquid in m/s, and the factor of
        its deviation in a time step.
    has_visits : bool
        True if bodies leave and enter; ``enter`` is the probability of an entry in a time step.
    """

    signal_error = 0.05
    """Standard deviation of the error of a body's signal, relative to the signal."""

    def __init__(self, task: Task) -> None:
        body: Any = task.body
        vessel: Any = task.vessel
        self.time_step = task.transport.time_step
        self.limit = vessel.radius - float(np.mean(body.radius_range))
        side = 2 * math.ceil(self.limit / SPACING) + 1
        self.shape, self.origin = (side, side), (side // 2, side // 2)
        low, high = body.speed_range
        speed = math.sqrt((low**2 + low * high + high**2) / 6.0)
        self.mean_velocity, self.velocity_std = np.zeros(2), np.array([speed, speed])
        self.decay = np.full(2, math.exp(-self.time_step / body.run_time))
        self.leave, self.enter = (-math.expm1(-self.time_step / time)
                                  for time in (body.visit_time, body.absence_time))
        self.has_visits = self.leave > 0.0

    def draw(self, random: np.random.Generator, count: int) -> np.ndarray:
        """Draw centres (count, 2) in m of bodies that are present."""
        angle = random.uniform(0.0, 2.0 * np.pi, count)
        distance = self.limit * np.sqrt(random.uniform(size=count))
        return np.stack([distance * np.cos(angle), distance * np.sin(angle)], axis=1)

    entries = draw

    def move(self, centres: np.ndarray, velocities: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return centres and velocities (..., 2) after a time step."""
        return reflect(centres + self.time_step * velocities, velocities, self.limit)

    def leaves(self, centres: np.ndarray, draw: np.ndarray) -> np.ndarray:
        """Return which bodies leave in a time step, for random numbers ``draw`` in (0, 1)."""
        return draw < self.leave

    def within(self, centres: np.ndarray) -> np.ndarray:
        """Return the centres (..., 2) after reflection at the walls."""
        return reflect(centres, centres, self.limit)[0]


class PipeMotion:
    """Bubbles in a plane pipe: velocity of the flow plus an Ornstein–Uhlenbeck velocity.

    The true bubbles have a constant slip and oscillate. See `TankMotion` for attributes and
    methods.
    """

    signal_error = 0.1
    has_visits = True
    slip_time, turn_time = 1.0, 0.1
    """s, correlation times of the velocities along and across the pipe"""

    def __init__(self, task: Task) -> None:
        body: Any = task.body
        vessel: Any = task.vessel
        self.time_step = dt = task.transport.time_step
        radius = float(np.mean(body.radius_range))
        self.limit = vessel.half_width - radius
        self.start, self.end = radius, vessel.length - radius
        rows = math.ceil(self.limit / SPACING)
        self.shape, self.origin = (math.ceil(vessel.length / SPACING) + 1, 2 * rows + 1), (0, rows)
        transport: Any = task.transport
        self.flow = transport.velocity
        self.mean_velocity = np.array([np.mean(body.slip_range), 0.0])
        slip_std = float(np.ptp(body.slip_range)) / math.sqrt(12.0)
        turning = 2.0 * np.pi * np.mean(body.frequency_range) * np.mean(body.amplitude_range)
        self.velocity_std = np.array([slip_std, turning / math.sqrt(2.0)])
        self.decay = np.exp([-dt / self.slip_time, -dt / self.turn_time])
        self.enter = -math.expm1(-dt / body.mean_wait)

    def draw(self, random: np.random.Generator, count: int) -> np.ndarray:
        return random.uniform([self.start, -self.limit], [self.end, self.limit], (count, 2))

    def entries(self, random: np.random.Generator, count: int) -> np.ndarray:
        """Draw centres (count, 2) in m of bodies that have entered during a time step."""
        centres = self.draw(random, count)
        inlet = np.stack([np.zeros(count), centres[:, 1]], axis=1)
        speed = self.flow(inlet)[:, 0] + self.mean_velocity[0]
        centres[:, 0] = self.start + self.time_step * speed * random.uniform(size=count)
        return centres

    def move(self, centres: np.ndarray, velocities: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        flow = self.flow(centres.reshape(-1, 2)).reshape(centres.shape)
        moved = centres + self.time_step * (velocities + flow)
        outside = np.abs(moved[..., 1]) > self.limit
        velocities = np.where(outside[..., None] * [False, True], -velocities, velocities)
        return self.within(moved), velocities

    def leaves(self, centres: np.ndarray, draw: np.ndarray) -> np.ndarray:
        return centres[..., 0] >= self.end

    def within(self, centres: np.ndarray) -> np.ndarray:
        x, y = np.moveaxis(centres, -1, 0)
        beyond = np.maximum(np.abs(y) - self.limit, 0.0)
        return np.stack([np.clip(x, self.start, self.end),
                         y - 2.0 * np.copysign(beyond, y)], axis=-1)


def body_motion(task: Task) -> TankMotion | PipeMotion:
    """Return the motion of a task's body."""
    return (PipeMotion if isinstance(task.body, RisingBubble) else TankMotion)(task)
