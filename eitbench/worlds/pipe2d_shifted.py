"""The thesis' 2D pipe when the truth is not what estimators are told, nor what they learned from.

In each world one thing is another than in `eitbench/Pipe2D-v0`, and the task is the very same. All
numbers are ours. What methods score: ``docs/robustness.md``.
"""

from dataclasses import replace
from typing import Any

from eitbench.worlds.flows import DrawnFlow
from eitbench.worlds.instrument import Instrument
from eitbench.worlds.pipe2d import PIPE_2D
from eitbench.worlds.registry import register
from eitbench.worlds.slugs import Slugs
from eitbench.worlds.world import World

HOME = "eitbench/Pipe2D-v0"
REST = f"""
All else is as in `{HOME}`, and the task is the same: estimators are told the same model, noise and
velocity, and what was learned for that pipe suits here. The robustness board shows what they score
here and there side by side (`docs/robustness.md`). `true_model_smoother` is told the true flow, and
of what has changed nothing else.
"""


def shifted(name: str, about: str, **parts: Any) -> World:
    """The thesis' pipe with these parts in place of its own, made playable under this name."""
    world = replace(PIPE_2D, **parts)
    if world.fluid != PIPE_2D.fluid:  # else it shares the episodes of home
        world = replace(world, name=name)
    register(world, f"eitbench/{name}-v0", home=HOME, about=about + REST)
    return world


PIPE_2D_SHORT_SLUGS = shifted(
    "Pipe2DShortSlugs", target=Slugs(duration=(3e-3, 7e-3)), about="""
Slugs pass in half the time: the standard deviation of one is 3 to 7 ms, at home 6 to 14 ms. Who
expects the inflow to go on as it was is wrong sooner.
""")

PIPE_2D_STRONG_SLUGS = shifted(
    "Pipe2DStrongSlugs", target=Slugs(strength=(0.33, 0.60)), about="""
Slugs are half as strong again: at its centre one changes the logarithm of the concentration by 0.33
to 0.60, at home by 0.22 to 0.40. Voltages are less linear in that, and priors expect less.
""")

PIPE_2D_DOUBLE_NOISE = shifted(
    "Pipe2DDoubleNoise", instrument=Instrument(untold_noise=2.0), about="""
The voltmeters' noise is twice what estimators are told. What flows in an episode is what flows at
home.
""")

PIPE_2D_OTHER_VELOCITY = shifted(
    "Pipe2DOtherVelocity", flow=DrawnFlow(velocity_range=(4.05, 4.95)), about="""
The mean velocity, 4.5 m/s as told, is drawn for each episode within 10 % of that, from 4.05 to 4.95
m/s. In `eitbench/Pipe2DBiasedVelocity-v0` it is from 2.5 to 7 m/s.
""")

PIPE_2D_OTHER_CONTACTS = shifted(
    "Pipe2DOtherContacts", instrument=Instrument(contact_spread=0.5), about="""
The contact impedance of each electrode is drawn for each episode within 50 % of what is told, from
1 to 3 mΩ·m². Voltages are those of the complete electrode model with these impedances.
""")

PIPE_2D_OTHER_INLET = shifted(
    "Pipe2DOtherInlet", target=Slugs(width=(6e-3, 9e-3), reach=(0.7, 0.95)), about="""
Slugs are narrow and enter near the walls, where the fluid is slow: their centres lie 0.7 to 0.95 R
from the axis, at home 0 to 0.7 R, and their standard deviation across is 6 to 9 mm, at home 10 to
25 mm.
""")
