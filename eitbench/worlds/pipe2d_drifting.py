"""The thesis' 2D pipe with a mean velocity that wanders, of which only a part downstream counts."""

from eitbench.worlds.flows import WanderingFlow
from eitbench.worlds.registry import register
from eitbench.worlds.slugs import Slugs
from eitbench.worlds.vessels import PlanePipe
from eitbench.worlds.world import World

PIPE_2D_DRIFTING = World("Pipe2DDriftingVelocity", PlanePipe(), WanderingFlow(), Slugs(),
                         region=(0.28, 0.40))
"""Errors are counted between two cross-sections; all numbers are ours."""

register(PIPE_2D_DRIFTING, "eitbench/Pipe2DInjectionFlow-v0", track="injection",
         seeds="test:0-29", about="""
The pipe of `eitbench/Pipe2D-v0` with a mean velocity that nobody knows and that drifts, a random
walk between 2.5 and 6.5 m/s. Only what flows through a region of interest counts, by default the
last 12 cm (`world={"region": null}`: the whole pipe). The filter inside estimates concentration and
mean velocity together (the joint extended Kalman filter of the thesis' chapter 6), from 4.5 ± 1
m/s. Slugs may be looked at when they enter, on the way or when they arrive; what is known of one
that has entered is worth no more than what is known of the flow that carries it.

This is a competition case: the adaptivity gap is 1.04, with a 95 % interval from 0.70 to 1.96 over
the board's 30 episodes. No hand-written policy that looks at the data has beaten random pairs,
which are as good as the best cycle; trained agents do (`docs/injection.md`).
""")
