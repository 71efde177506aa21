"""The 2D pipe with a dent in its lower wall: the flow separates, and no parabola describes it."""

from eitbench.worlds.flows import FlowPastBulge
from eitbench.worlds.registry import register
from eitbench.worlds.slugs import Slugs
from eitbench.worlds.vessels import Bulge, PlanePipe
from eitbench.worlds.world import World

PIPE_2D_OBSTACLE = World("Pipe2DObstacle", PlanePipe(bulge=Bulge()), FlowPastBulge(), Slugs())
"""Behind the bulge the fluid recirculates over more than half of the pipe. All numbers are ours."""

register(PIPE_2D_OBSTACLE, "eitbench/Pipe2DObstacle-v0", about="""
The pipe of `eitbench/Pipe2D-v0` with a bulge in its lower wall. The flow separates behind it and
recirculates; it solves the steady Navier–Stokes equations. Estimators know the walls, but their
model assumes a parabola between them at each place; with `assume={"flow": "real"}` they are given
the real flow. How far does the simple model of the thesis carry, and what is gained by a better one
(Seppänen 2005, 5.1.1, names better fluid models as the next step)?
""")
