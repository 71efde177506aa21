"""The thesis' 2D pipe with a parabolic flow of unknown mean, estimated too (6.2, Figs 6.1, 6.2)."""

from eitbench.worlds.flows import DrawnFlow
from eitbench.worlds.registry import register
from eitbench.worlds.slugs import Slugs
from eitbench.worlds.vessels import PlanePipe
from eitbench.worlds.world import World

ASKED = """
The axial velocity is written as v̂(y) = Σ θ_k φ_k(y/R); `task.velocity` holds the φ_k, what is
believed of θ at first, and how fast it may change. On the leaderboard the errors of concentration
and flow are ẽ_c and ẽ_v; ẽ_c ranks.
"""

PIPE_2D_UNKNOWN = World("Pipe2DUnknownVelocity", PlanePipe(),
                        DrawnFlow(velocity_range=(3.0, 6.5), profiles="mean"), Slugs())
"""Believed at first: 4.5 ± 1 m/s [ours]."""

register(PIPE_2D_UNKNOWN, "eitbench/Pipe2DUnknownVelocity-v0", seeds="test:0-5", about=f"""
The pipe of `eitbench/Pipe2D-v0`, but the flow is not known: parabolic, with a mean of 3 … 6.5 m/s
drawn for each episode. Estimate the concentration and the mean velocity from the voltages (Seppänen
2005, 6.2, example 1).
{ASKED}""")
