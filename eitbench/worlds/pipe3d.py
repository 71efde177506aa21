"""The thesis' 3D pipe (5.2, Fig. 5.10): laminar flow in a round pipe with rings of electrodes."""

from eitbench.worlds.flows import LaminarFlow
from eitbench.worlds.registry import register
from eitbench.worlds.schedule import RingsInTurn, Schedule
from eitbench.worlds.slugs import Slugs
from eitbench.worlds.vessels import RoundPipe
from eitbench.worlds.world import World

PIPE_3D = World("Pipe3D", RoundPipe(), LaminarFlow(), Slugs(),
                schedule=Schedule(scored_steps=48, pattern=RingsInTurn()))
"""The page at hand shows the figure only: times, velocity and noise are those of the thesis' 2D
pipe. Three frames are scored [ours]."""

ABOUT = """
Fluid streams through a round pipe, 40 cm long and 10 cm wide, at 4.5 m/s on average; slugs of
higher and lower concentration enter at random. Four rings of eight electrodes on the wall, one
current injection every 5 ms. From the voltages of each injection, and a model of flow, estimate the
concentration everywhere (Seppänen 2005, 5.2, Fig. 5.10).

The first use of a seed simulates its truth (one to two minutes), which is then kept on disk;
`eitbench bank` does so for many seeds ahead of time.
"""

register(PIPE_3D, "eitbench/Pipe3D-v0", seeds="test:0-5", about=ABOUT)
register(PIPE_3D, "eitbench/Pipe3DSmoothing-v0", seeds="test:0-5", lag="all",
         about=f"{ABOUT}\nHere every state is asked for, once the whole record has been played.\n")
