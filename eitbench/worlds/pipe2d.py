"""The thesis' 2D pipe (5.1): a known parabolic flow carries slugs past two rows of electrodes."""

from eitbench.worlds.flows import LaminarFlow
from eitbench.worlds.registry import register
from eitbench.worlds.slugs import Slugs
from eitbench.worlds.vessels import PlanePipe
from eitbench.worlds.world import World

PIPE_2D = World("Pipe2D", PlanePipe(), LaminarFlow(), Slugs())
"""A straight plane channel with laminar flow (thesis 5.1.1, Figs 5.1–5.6).

One injection a time step; in the 16 injections of a frame the fluid moves 36 cm on average, almost
the whole pipe.
"""

ABOUT = """
Fluid streams through a straight 2D pipe, 40 cm long and 10 cm wide, at 4.5 m/s on average; slugs of
higher and lower concentration enter at random. Sixteen electrodes on the walls, one current
injection every 5 ms: while a frame of 16 injections is measured, the fluid moves on by 36 cm. From
the voltages of each injection, and a model of flow, estimate the concentration everywhere (Seppänen
2005, ch. 5).

The homogeneous estimate scores about 0.02, a Kalman filter about 0.0045.
`assume={"mean_velocity": 4.0}` tells estimators another velocity than the true one.
"""
LATER = "\nHere the state of four injections before is asked for.\n"
WHOLE = "\nHere every state is asked for, once the whole record has been played.\n"

register(PIPE_2D, "eitbench/Pipe2D-v0", about=ABOUT)
register(PIPE_2D, "eitbench/Pipe2DFixedLag-v0", about=ABOUT + LATER, lag=4)
register(PIPE_2D, "eitbench/Pipe2DSmoothing-v0", about=ABOUT + WHOLE, lag="all")
