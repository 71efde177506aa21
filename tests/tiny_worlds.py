"""Worlds with episodes of a third of a second, derived from built-in worlds."""

from eitbench.worlds.catalogue import PIPE_2D

from short import merged

CHANGES = {"flow": {"mean_velocity": 45.0}, "vessel": {"electrodes_per_wall": 2},
           "schedule": {"scored_steps": 3, "pattern": {"frame": 2}}}
"""A fast fluid flushes the pipe in two steps: the last three of five measurements are scored."""
TINY = PIPE_2D.with_changes(CHANGES)
FAST = merged(CHANGES, {"flow": {"velocity_range": [40.0, 50.0]}})
"""The same with a flow that is drawn for each episode."""
