"""The thesis' 2D pipe with another mean velocity than estimators assume (5.1.2, Figs 5.7, 5.8)."""

from eitbench.worlds.flows import DrawnFlow
from eitbench.worlds.registry import register
from eitbench.worlds.slugs import Slugs
from eitbench.worlds.vessels import PlanePipe
from eitbench.worlds.world import World

PIPE_2D_BIASED = World("Pipe2DBiasedVelocity", PlanePipe(),
                       DrawnFlow(velocity_range=(2.5, 7.0)), Slugs())
"""The thesis keeps the truth at 4.5 m/s and varies what is assumed; so that nobody gains by knowing
the one true velocity, here the truth varies [ours]. What methods score: ``docs/velocity.md``."""

register(PIPE_2D_BIASED, "eitbench/Pipe2DBiasedVelocity-v0", about="""
The pipe of `eitbench/Pipe2D-v0`, but the mean velocity that estimators are told, 4.5 m/s, is not
the true one, which is drawn for each episode from 2.5 … 7 m/s (Seppänen 2005, 5.1.2, Figs 5.7 and
5.8). How much does a method suffer from a wrong model of the flow?

In the thesis the truth is 450 cm/s and the assumed velocity varies; that is
`gym.make(id, world={"flow": {"velocity_range": [4.5, 4.5]}}, assume={"mean_velocity": 2.0})` here.
`assume={"profile": "plug"}` or `"power-law"` (exponent 1/7) lets the model believe in another
profile.
""")
