"""The thesis' 2D pipe with an instrument that is falling apart."""

from eitbench.worlds.instrument import Instrument
from eitbench.worlds.pipe2d import PIPE_2D
from eitbench.worlds.registry import register
from eitbench.worlds.world import World

PIPE_2D_FAULTS = World(
    "Pipe2D", PIPE_2D.vessel, PIPE_2D.flow, PIPE_2D.target,
    Instrument(noise_floor=1e-4, interference=0.5, dead=(2, 4), failing=(1, 2), loose=(0, 2)))
"""A bad contact has 0.5 to 2 Ω·m more (a sound one: 0.08) and five times the noise [all ours]."""

register(PIPE_2D_FAULTS, "eitbench/Pipe2DInjectionFaults-v0", track="injection",
         seeds="test:0-49", gate=8.0, about="""
`eitbench/Pipe2DInjection-v0` with an instrument that is falling apart. In every episode other
electrodes are dead from the beginning, others fail on the way, others have a bad contact, and
nobody announces it. A current that would have to pass a broken wire does not flow; the reading of
such an electrode is interference, 0.5 V (std), about as much as the largest voltages. The filter
inside leaves out readings that are further than 8 standard deviations (`gate`) from its prediction,
and a whole injection if that is so of more than a third of its readings.

Which pair is best depends on the episode, and the measurements tell (`doubt` and `innovations` show
what is broken): the adaptivity gap is 0.52, with a 95 % interval from 0.28 to 0.82 over the
board's 50 episodes (`docs/injection.md`).
""")
