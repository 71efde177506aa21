"""The stirred tank in which an agent chooses what to inject."""

from eitbench.worlds.registry import register
from eitbench.worlds.rotating_tank import ROTATING_TANK_2D

register(ROTATING_TANK_2D, "eitbench/RotatingTankInjection-v0", track="injection", about="""
The stirred tank of `eitbench/RotatingTank2D-v0`: a ball that hardly conducts is carried round on a
path that nobody knows beforehand. Here the agent chooses which pair of electrodes injects. The
filter inside knows the liquid's flow and of no ball. The first frame is one injection of 0 → 8.

This is a reference case, not a competition: the liquid carries the ball past every pair, between
random pairs and the clairvoyant there are 8 % of ẽ_c, and no policy that looks at the data has
beaten the best pair. The adaptivity gap is 0.25, with a 95 % interval from 0.05 to 0.40 over the
board's 10 episodes, a quotient of small numbers (`docs/injection.md`).
""")
