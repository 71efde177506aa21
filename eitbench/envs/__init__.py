"""Floor 4: the Gymnasium environments and their registration."""

from typing import Any

import gymnasium as gym

ESTIMATION: dict[str, tuple[str, dict]] = {
    "eitbench/Pipe2D-v0": ("eitbench.envs.pipe2d:Pipe2D", {}),
    "eitbench/Pipe2DFixedLag-v0": ("eitbench.envs.pipe2d:Pipe2D", {"lag": 4}),
    "eitbench/Pipe2DSmoothing-v0": ("eitbench.envs.pipe2d:Pipe2D", {"lag": "all"}),
    "eitbench/Pipe2DBiasedVelocity-v0": ("eitbench.envs.pipe2d_biased:Pipe2DBiasedVelocity", {}),
    "eitbench/Pipe2DUnknownVelocity-v0": ("eitbench.envs.pipe2d_velocity:Pipe2DVelocity", {"flow": "unknown"}),
    "eitbench/Pipe2DTimeVaryingVelocity-v0": ("eitbench.envs.pipe2d_velocity:Pipe2DVelocity", {"flow": "time-varying"}),
    "eitbench/Pipe2DSkewedVelocity-v0": ("eitbench.envs.pipe2d_velocity:Pipe2DVelocity", {"flow": "skewed"}),
    "eitbench/Pipe2DObstacle-v0": ("eitbench.envs.pipe2d_obstacle:Pipe2DObstacle", {}),
    "eitbench/Pipe3D-v0": ("eitbench.envs.pipe3d:Pipe3D", {}),
    "eitbench/Pipe3DSmoothing-v0": ("eitbench.envs.pipe3d:Pipe3D", {"lag": "all"}),
    "eitbench/RotatingTank2D-v0": ("eitbench.envs.rotating_tank:RotatingTank2D", {}),
    "eitbench/StationaryTank2D-v0": ("eitbench.envs.stationary_tank:StationaryTank2D", {}),
}
"""Environments that ask for estimates: where the classes …Env and …VectorEnv lie, and what they are given."""

INJECTION: dict[str, tuple[str, dict]] = {
    "eitbench/Pipe2DInjection-v0": ("eitbench.envs.pipe2d_injection:Pipe2DInjection", {}),
    "eitbench/Pipe2DInjectionCurrents-v0": (
        "eitbench.envs.pipe2d_injection:Pipe2DInjection", {"limit": "Linf", "noise_floor": 2e-4}),
    "eitbench/Pipe2DInjectionFaults-v0": ("eitbench.envs.pipe2d_injection_faults:Pipe2DInjectionFaults", {}),
    "eitbench/Pipe2DInjectionBudget-v0": ("eitbench.envs.pipe2d_injection_budget:Pipe2DInjectionBudget", {}),
    "eitbench/Pipe2DInjectionFlow-v0": ("eitbench.envs.pipe2d_injection_flow:Pipe2DInjectionFlow", {}),
    "eitbench/RotatingTankInjection-v0": ("eitbench.envs.rotating_tank_injection:RotatingTankInjection", {}),
}
"""Environments that ask for injections."""

ENTRY_POINTS = ESTIMATION | INJECTION


def register_all() -> None:
    """Register every environment by its string entry points, one at a time and vectorised."""
    for name, (entry_point, kwargs) in ENTRY_POINTS.items():
        gym.register(name, entry_point=f"{entry_point}Env", vector_entry_point=f"{entry_point}VectorEnv", kwargs=kwargs)


def scenario_of(name: str, kwargs: dict[str, Any] | None = None) -> Any:
    """The scenario that an environment plays; ``ValueError`` if there is none of this id."""
    if name not in ENTRY_POINTS:
        raise ValueError(f"env must be one of {', '.join(ENTRY_POINTS)}; got {name!r}")
    return gym.make(name, disable_env_checker=True, **(kwargs or {})).unwrapped.scenario  # type: ignore[attr-defined]
