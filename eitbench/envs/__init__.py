"""Floor 4: the Gymnasium environments and their registration."""

import gymnasium as gym

ENTRY_POINTS: dict[str, tuple[str, dict]] = {
    "eitbench/Pipe2D-v0": ("eitbench.envs.pipe2d:Pipe2DEnv", {}),
    "eitbench/Pipe2DFixedLag-v0": ("eitbench.envs.pipe2d:Pipe2DEnv", {"lag": 4}),
    "eitbench/Pipe2DSmoothing-v0": ("eitbench.envs.pipe2d:Pipe2DEnv", {"lag": "all"}),
}


def register_all() -> None:
    """Register every environment by its string entry point."""
    for name, (entry_point, kwargs) in ENTRY_POINTS.items():
        gym.register(name, entry_point=entry_point, kwargs=kwargs)
