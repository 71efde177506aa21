"""Floor 2: one short file per example; a scenario says what world it is, with the source of every number."""

from eitbench.worlds.pipe2d import Pipe2D
from eitbench.worlds.pipe2d_drift import Pipe2DDriftingVelocity
from eitbench.worlds.pipe2d_flows import (
           Pipe2DBiasedVelocity,
           Pipe2DSkewedVelocity,
           Pipe2DTimeVaryingVelocity,
           Pipe2DUnknownVelocity,
)
from eitbench.worlds.pipe2d_intermittent import Pipe2DIntermittent
from eitbench.worlds.pipe2d_obstacle import Pipe2DObstacle
from eitbench.worlds.pipe3d import Pipe3D
from eitbench.worlds.rotating_tank import RotatingTank2D
from eitbench.worlds.stationary_tank import StationaryTank2D

__all__ = ["Pipe2D", "Pipe2DBiasedVelocity", "Pipe2DDriftingVelocity", "Pipe2DIntermittent", "Pipe2DObstacle",
           "Pipe2DSkewedVelocity", "Pipe2DTimeVaryingVelocity", "Pipe2DUnknownVelocity", "Pipe3D", "RotatingTank2D",
           "StationaryTank2D"]
