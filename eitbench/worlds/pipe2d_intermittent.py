"""The thesis' 2D pipe when slugs are rare: most of the time there is nothing to see."""

from dataclasses import replace

from eitbench.worlds.flows import LaminarFlow
from eitbench.worlds.registry import register
from eitbench.worlds.schedule import Schedule
from eitbench.worlds.slugs import NowAndThen, Slugs
from eitbench.worlds.vessels import PlanePipe
from eitbench.worlds.world import World

PIPE_2D_INTERMITTENT = World(
    "Pipe2DIntermittent", PlanePipe(), LaminarFlow(),
    Slugs(strength=(0.35, 0.60), arrivals=NowAndThen(interval=0.10, wait=0.20)),
    schedule=Schedule(scored_steps=180))
"""Strong slugs, about three in the injections that are scored; all numbers are ours."""
PIPE_2D_BUDGET = replace(PIPE_2D_INTERMITTENT,
                         schedule=replace(PIPE_2D_INTERMITTENT.schedule, budget=30))
"""The same episodes, in which an agent may inject at one step in six only."""

register(PIPE_2D_INTERMITTENT, "eitbench/Pipe2DIntermittent-v0", seeds="test:0-15", about="""
The pipe of `eitbench/Pipe2D-v0` when slugs are rare: strong ones come one at a time, at times
nobody foresees, about three in an episode. Between them what flows in does not change. A Gaussian
prior of the inflow has to believe in a little of a slug at every moment; who asks whether a slug
has come at all can be sure of the quiet, and wide awake when it ends. The episodes are those of
`eitbench/Pipe2DInjectionBudget-v0`, with an injection at every step.
""")
register(PIPE_2D_BUDGET, "eitbench/Pipe2DInjectionInflowBudget-v0", track="injection",
         seeds="test:0-49", inflow="learned", about="""
The rare slugs and the budget of `eitbench/Pipe2DInjectionBudget-v0`, with the filter of
`eitbench/Pipe2DInjectionInflow-v0`, which has learned from training inflows what flows in. On the
episodes dev:0-7 the adaptivity gap is 0.45, with a 95 % interval from 0.34 to 0.62
(`docs/injection.md`).
""")
register(PIPE_2D_BUDGET, "eitbench/Pipe2DInjectionBudget-v0", track="injection",
         seeds="test:0-49", about="""
The pipe of `eitbench/Pipe2D-v0` when slugs are rare: strong ones come one at a time, at times
nobody foresees, about three in an episode. The agent may inject at one step in six only, so it has
to notice that a slug has come and then look closely, and to keep something for the next one. Once
the budget is spent every action is no injection (`action_masks`); within it injections cost
nothing. Where nothing is injected `voltages` are the amplifiers' noise (here none) and
`innovations` zero. The first frame does not count against the budget.

The adaptivity gap is 0.51, with a 95 % interval from 0.45 to 0.57 over the board's 50 episodes
(`docs/injection.md`).
""")
