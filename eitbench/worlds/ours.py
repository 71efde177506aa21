"""All our worlds; importing this registers their ids, in the order of the thesis."""

from eitbench.worlds import (  # noqa: I001 (the order in which boards and pages show them)
    pipe2d,
    pipe2d_biased,
    pipe2d_unknown,
    pipe2d_time_varying,
    pipe2d_skewed,
    pipe2d_obstacle,
    pipe3d,
    rotating_tank,
    stationary_tank,
    pipe2d_injection,
    pipe2d_faults,
    pipe2d_intermittent,
    pipe2d_drifting,
    rotating_tank_injection,
)

__all__ = ["pipe2d", "pipe2d_biased", "pipe2d_drifting", "pipe2d_faults", "pipe2d_injection",
           "pipe2d_intermittent", "pipe2d_obstacle", "pipe2d_skewed", "pipe2d_time_varying",
           "pipe2d_unknown", "pipe3d", "rotating_tank", "rotating_tank_injection",
           "stationary_tank"]
