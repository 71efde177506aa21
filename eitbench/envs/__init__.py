"""Floor 4: the Gymnasium environments and their registration."""

import gymnasium as gym

ENTRY_POINTS: dict[str, tuple[str, dict]] = {
    "eitbench/Pipe2D-v0": ("eitbench.envs.pipe2d:Pipe2D", {}),
    "eitbench/Pipe2DFixedLag-v0": ("eitbench.envs.pipe2d:Pipe2D", {"lag": 4}),
    "eitbench/Pipe2DSmoothing-v0": ("eitbench.envs.pipe2d:Pipe2D", {"lag": "all"}),
}
"""Environments by id: where the classes …Env and …VectorEnv lie, and what they are given."""


def register_all() -> None:
    """Register every environment by its string entry points, one at a time and vectorised."""
    for name, (entry_point, kwargs) in ENTRY_POINTS.items():
        gym.register(name, entry_point=f"{entry_point}Env", vector_entry_point=f"{entry_point}VectorEnv", kwargs=kwargs)
