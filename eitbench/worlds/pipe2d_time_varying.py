"""The thesis' 2D pipe with a mean velocity that changes in time (6.3, Fig. 6.3)."""

from eitbench.worlds.flows import DrawnFlow
from eitbench.worlds.pipe2d_unknown import ASKED
from eitbench.worlds.registry import register
from eitbench.worlds.slugs import Slugs
from eitbench.worlds.vessels import PlanePipe
from eitbench.worlds.world import World

PIPE_2D_TIME_VARYING = World(
    "Pipe2DTimeVaryingVelocity", PlanePipe(),
    DrawnFlow(velocity_range=(3.5, 5.5), swing_range=(0.2, 0.35), profiles="mean",
              velocity_walk=0.1), Slugs())
"""A sine of 20 … 35 % about 3.5 … 5.5 m/s; estimators are told that the flow changes [ours]."""

register(PIPE_2D_TIME_VARYING, "eitbench/Pipe2DTimeVaryingVelocity-v0", seeds="test:0-5", about=f"""
The pipe of `eitbench/Pipe2D-v0` with a parabolic flow whose mean is a sine in time of 20 … 35 %,
drawn for each episode. Estimate the concentration and the mean velocity from the voltages (Seppänen
2005, 6.3, example 2).
{ASKED}""")
