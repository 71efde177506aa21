"""A short world for every id: what is promised does not depend on the length of a record."""

from eitbench.envs import ENTRY_POINTS

PLAIN = [name for name, (classes, _) in ENTRY_POINTS.items() if classes.endswith((":Pipe2D", ":Pipe2DInjection"))]
"""Ids that play the thesis' pipe as it is, `Pipe2D`."""
PIPE = {"mean_velocity": 45.0, "scored_steps": 5, "electrodes_per_wall": 2, "frame": 2}
"""A fast fluid flushes the pipe in two steps: seven measurements, of which five are scored."""
FLOW = PIPE | {"velocity_range": (40.0, 50.0)}

FIELDS = {
    "Pipe2D": PIPE,
    "Pipe2DInjection": PIPE,
    "Pipe2DInjectionFaults": PIPE,
    "Pipe2DInjectionBudget": PIPE,
    "Pipe2DInjectionFlow": FLOW,
    "Pipe2DBiasedVelocity": FLOW,
    "Pipe2DVelocity": FLOW,
    "Pipe2DObstacle": PIPE | {"viscosity": 0.04, "obstacle_height": 0.01},
    "Pipe3D": {"mean_velocity": 45.0, "scored_steps": 3, "frame": 2, "potential_order": 1},
    "RotatingTank2D": {"n_electrodes": 8, "warm_up": 1, "scored_steps": 4},
    "RotatingTankInjection": {"n_electrodes": 8, "warm_up": 1, "scored_steps": 4},
    "StationaryTank2D": {"n_electrodes": 8, "scored_steps": 5},
}
"""Fields of the scenario by the name that the classes …Env and …VectorEnv of an id begin with."""


ARGUMENTS = {
    "Pipe3D": {"electrode_rings": 1, "electrodes_per_ring": 4},
    "Pipe2DInjectionFaults": {"dead": [0, 1], "failing": [0, 1], "loose": [0, 0]},
}
"""What else must be small where there are four electrodes."""


def kind(name: str) -> str:
    """What the classes of an id are called, without …Env."""
    return ENTRY_POINTS[name][0].split(":")[1]


def world(name: str) -> dict:
    """Keyword arguments that make an id's episodes short."""
    assert kind(name) in FIELDS, f"{name} has no short version yet: give {kind(name)!r} one in tests/short.py"
    return {"scenario": FIELDS[kind(name)]} | ARGUMENTS.get(kind(name), {})


def short(name: str) -> dict:
    """And its training episodes few."""
    return world(name) | {"episodes": 2}
