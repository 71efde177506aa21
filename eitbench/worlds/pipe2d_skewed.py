"""The thesis' 2D pipe with a non-symmetric flow, estimated by three numbers (6.4, Figs 6.4–6.6)."""

from eitbench.worlds.flows import DrawnFlow
from eitbench.worlds.pipe2d_unknown import ASKED
from eitbench.worlds.registry import register
from eitbench.worlds.slugs import Slugs
from eitbench.worlds.vessels import PlanePipe
from eitbench.worlds.world import World

PIPE_2D_SKEWED = World(
    "Pipe2DSkewedVelocity", PlanePipe(),
    DrawnFlow(velocity_range=(4.0, 5.0), skewness_range=(0.6, 1.0), profiles="three",
              velocity_walk=0.005), Slugs())
"""The truth is (1 − η²)·exp(kη), which no combination of the three profiles equals: the fastest
fluid is 0.28 R to 0.41 R off the axis. Of a steady flow three numbers are to be told [ours]."""

register(PIPE_2D_SKEWED, "eitbench/Pipe2DSkewedVelocity-v0", seeds="test:0-5", about=f"""
The pipe of `eitbench/Pipe2D-v0` with a flow that is not symmetric, drawn for each episode. It is
estimated as a combination of three profiles, of which none equals it: the parabola, a skew cubic,
and a quartic that flattens or sharpens the profile without a net flux (Seppänen 2005, 6.4, example
3).
{ASKED}""")
