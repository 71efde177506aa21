"""The thesis' 2D pipe in which an agent injects: by electrode pairs, or at each electrode."""

from eitbench.worlds.instrument import Instrument
from eitbench.worlds.pipe2d import PIPE_2D
from eitbench.worlds.registry import register
from eitbench.worlds.world import World

PIPE_2D_CURRENTS = World("Pipe2D", PIPE_2D.vessel, PIPE_2D.flow, PIPE_2D.target,
                         Instrument(noise_floor=2e-4, limit="Linf"))
"""A source for each electrode; with relative noise alone the amplitude would not matter [ours]."""

ABOUT = """
The pipe of `eitbench/Pipe2D-v0`; here the agent chooses at every step how the current flows. A
Kalman filter inside takes in the voltages and estimates the concentration; it is the same for every
agent, so that agents differ only in what they inject.
"""

register(PIPE_2D, "eitbench/Pipe2DInjection-v0", track="injection", about=f"""{ABOUT}
This is the reference case, not a competition: one pair near the inlet, injected for ever, is as
good as anything (what is known at the inlet the flow carries through the whole pipe), and what to
inject does not depend on what is measured. The adaptivity gap is none (`docs/injection.md`).
""")
register(PIPE_2D, "eitbench/Pipe2DInjectionInflow-v0", track="injection", inflow="learned",
         about=f"""{ABOUT}
Here the filter has learned from training inflows how slugs last and how wide they are
(`docs/methods.md`, 10), and linearises about each prediction; in `eitbench/Pipe2DInjection-v0` it
takes them for white noise, Table 5.1. With the best pair at the inlet the error is a seventh of
what it is there, and this is as much a reference: the adaptivity gap is none (`docs/injection.md`).
""")
register(PIPE_2D_CURRENTS, "eitbench/Pipe2DInjectionCurrents-v0", track="injection",
         about=f"""{ABOUT}
This is the same world with a current of its own for each electrode, and as much a reference: the
best currents, the same at every step, take a tenth off the ẽ_c of any pairs, and the clairvoyant 2
% more. The adaptivity gap is none.

Actions are in parts of the instrument's 0.1 A/m. Entries beyond ±1 are first cut to ±1; then their
mean is taken away (Σ I = 0); if they still exceed the limit, they are scaled down to it. The limit
is the norm of a pair: Σ|I| ≤ 2 ("L1", a total current), Σ I² ≤ 2 ("L2", a power) or |I| ≤ 1
("Linf", a source for each electrode):
`world={{"instrument": {{"limit": "L1"}}}}`.
""")
