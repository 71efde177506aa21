"""The thesis' 2D pipe when the truth is not what estimators are told, nor what they learned from.

In each world one thing is another than in `eitbench/Pipe2D-v0`, and the task is the very same: by
how much is [ours]. What methods score: ``docs/robustness.md``.
"""

from dataclasses import replace

from eitbench.worlds.flows import DrawnFlow
from eitbench.worlds.instrument import Instrument
from eitbench.worlds.pipe2d import PIPE_2D
from eitbench.worlds.registry import register
from eitbench.worlds.slugs import Slugs
from eitbench.worlds.world import World

HOME = "eitbench/Pipe2D-v0"
SLUGS = Slugs()


def shifted(name: str, about: str, **parts: object) -> World:
    """The thesis' pipe with these parts in place of its own, registered under this name."""
    id = f"eitbench/{name}-v0"
    # the instrument's noise moves no fluid: such a world shares the episodes of the pipe
    world = replace(PIPE_2D, **parts)  # type: ignore[arg-type]
    if world.fluid != PIPE_2D.fluid:
        world = replace(world, name=name)
    register(world, id, home=HOME, about=f"""
The pipe of `{HOME}`, and the same task: the same model, the same noise and the same velocity are
told, and the same priors and networks suit it. But {about}

How much of what a method scores at home does it lose? The robustness board shows both side by side
(`docs/robustness.md`). `true_model_smoother` is told the true flow here, and nothing else of what
has changed.
""")
    return world


PIPE_2D_SHORT_SLUGS = shifted("Pipe2DShortSlugs", """slugs pass in half the time: the standard
deviation of one is 3 to 7 ms, where at home it is 6 to 14 ms. Who expects the inflow to go on as it
was is wrong sooner.""", target=replace(SLUGS, duration=(3e-3, 7e-3)))

PIPE_2D_STRONG_SLUGS = shifted("Pipe2DStrongSlugs", """slugs are half as strong again: at its centre
one changes the logarithm of the concentration by 0.33 to 0.60, where at home it is 0.22 to 0.40.
Estimators linearise about a flatter fluid than there is.""",
                               target=replace(SLUGS, strength=(0.33, 0.60)))

PIPE_2D_DOUBLE_NOISE = shifted("Pipe2DDoubleNoise", """the voltmeters' noise is twice what
estimators are told. The fluid and its episodes are those of home.""", instrument=Instrument(untold_noise=2.0))

PIPE_2D_OTHER_VELOCITY = shifted("Pipe2DOtherVelocity", """the mean velocity, 4.5 m/s as told, is
drawn for each episode within 10 % of that, from 4.05 to 4.95 m/s.
`eitbench/Pipe2DBiasedVelocity-v0` draws it from 2.5 to 7 m/s.""",
                                 flow=DrawnFlow(velocity_range=(4.05, 4.95)))

PIPE_2D_OTHER_CONTACTS = shifted("Pipe2DOtherContacts", """the contact impedance of each electrode
is drawn for each episode within 50 % of the one that is told, from 1 to 3 mΩ·m². Voltages are those
of the complete electrode model with these impedances.""", instrument=Instrument(contact_spread=0.5))

PIPE_2D_OTHER_INLET = shifted("Pipe2DOtherInlet", """slugs are narrow and enter near the walls:
their centres lie 0.7 to 0.95 R from the axis, where at home none does, and their standard deviation
across is 6 to 9 mm, where at home it is 10 to 25 mm. The fluid is slow there.""",
                              target=replace(SLUGS, width=(6e-3, 9e-3), reach=(0.7, 0.95)))
