"""`eitbench/Pipe2DObstacle-v0`."""

from __future__ import annotations

from typing import Any

from gymnasium.utils import EzPickle

from eitbench.envs.arguments import with_fields
from eitbench.envs.estimation import EstimationEnv
from eitbench.envs.estimation_vector import EstimationVectorEnv
from eitbench.worlds import Pipe2DObstacle
from eitbench.worlds.pipe2d_obstacle import FLOWS


class Pipe2DObstacleEnv(EstimationEnv, EzPickle):
    """
    ## Description

    The pipe of `eitbench/Pipe2D-v0` with a bulge in its lower wall. The flow separates behind it and recirculates; it
    solves the steady Navier–Stokes equations. Estimators know the walls, but their model assumes a parabola between
    them at each place; with `assumed_flow="real"` they are given the real flow (all numbers in
    `eitbench.worlds.Pipe2DObstacle`). How far does the simple model of the thesis carry, and what is gained by a
    better one (Seppänen 2005, 5.1.1, names better fluid models as the next step)?

    ## Action space

    `Box(-250, 250, (1701,), float64)`: the estimate of c_{t − lag} at the nodes of `task.mesh`, mol/m³.

    ## Observation space

    As in `eitbench/Pipe2D-v0`: `voltages` in V and `currents` in A per metre of depth, 16 of each.

    ## Reward

    −∫(ĉ_t − c_t)² dΩ / ∫c_t² dΩ for the 80 scored states t = 19 … 98, else 0.

    ## Starting state

    The fluid has been flowing for one flush time of the straight pipe. `reset(seed=s)` plays episode s.

    ## Episode end

    Terminated after 98 + lag steps. Never truncated.

    ## Arguments

    | name | default | meaning |
    |---|---|---|
    | `assumed_flow` | "parabolic" | what the task's model believes: "parabolic" or "real" |
    | `lag` | 0 | an integer from 0 to 97, or "all" (= 97): whole record first |
    | `scenario` | None | dict of `Pipe2DObstacle` fields to change |
    | `episodes` | 1000 | number of training episodes for unseeded resets |
    | `render_mode` | None | "rgb_array": truth, estimate, spread and active pair |

    ## Version history

    * v0: first version.
    """

    def __init__(self, *, assumed_flow: str = "parabolic", lag: int | str = 0, scenario: dict[str, Any] | None = None,
                 episodes: int = 1000, render_mode: str | None = None) -> None:
        EzPickle.__init__(self, assumed_flow=assumed_flow, lag=lag, scenario=scenario, episodes=episodes,
                          render_mode=render_mode)
        super().__init__(with_fields(Pipe2DObstacle, scenario), lag=lag, assumptions=_assumptions(assumed_flow),
                         episodes=episodes, render_mode=render_mode)


class Pipe2DObstacleVectorEnv(EstimationVectorEnv):
    """`Pipe2DObstacleEnv`, many times; arguments as there."""

    def __init__(self, *, num_envs: int = 1, assumed_flow: str = "parabolic", lag: int | str = 0,
                 scenario: dict[str, Any] | None = None, episodes: int = 1000) -> None:
        _assumptions(assumed_flow)                       # what estimators believe changes nothing here
        super().__init__(with_fields(Pipe2DObstacle, scenario), num_envs, lag=lag, episodes=episodes)


def _assumptions(flow: str) -> dict[str, str]:
    if flow not in FLOWS:
        raise ValueError(f"assumed_flow must be one of {', '.join(FLOWS)}, got {flow!r}")
    return {} if flow == "parabolic" else {"flow": flow}
