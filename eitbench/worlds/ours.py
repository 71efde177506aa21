"""All our worlds; importing this registers their ids, in the order of the thesis."""

from eitbench.worlds import (  # noqa: F401, I001 (in the order of boards and pages)
    pipe2d,
    pipe2d_biased,
    pipe2d_unknown,
    pipe2d_time_varying,
    pipe2d_skewed,
    pipe2d_obstacle,
    pipe2d_shifted,
    pipe3d,
    rotating_tank,
    stationary_tank,
    pipe2d_injection,
    pipe2d_faults,
    pipe2d_intermittent,
    pipe2d_drifting,
    rotating_tank_injection,
)
