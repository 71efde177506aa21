"""Floor 2: one short file per example; a scenario says what world it is, with the source of every number."""

from eitbench.scenarios.pipe2d import Pipe2D
from eitbench.scenarios.pipe2d_flows import (
    Pipe2DBiasedVelocity,
    Pipe2DSkewedVelocity,
    Pipe2DTimeVaryingVelocity,
    Pipe2DUnknownVelocity,
)

__all__ = ["Pipe2D", "Pipe2DBiasedVelocity", "Pipe2DSkewedVelocity", "Pipe2DTimeVaryingVelocity",
           "Pipe2DUnknownVelocity"]
