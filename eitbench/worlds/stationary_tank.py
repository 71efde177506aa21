"""The tank at rest (thesis 7.2): two metal cylinders in saline; a Kalman filter has F = I."""

from eitbench.worlds.bodies import Cylinders
from eitbench.worlds.flows import NoFlow
from eitbench.worlds.parts import Prior
from eitbench.worlds.registry import register
from eitbench.worlds.schedule import AroundTheTank, Schedule
from eitbench.worlds.vessels import RoundTank
from eitbench.worlds.world import World

STATIONARY_TANK_2D = World(
    "StationaryTank2D", RoundTank(), NoFlow(), Cylinders(),
    schedule=Schedule(time_step=0.02, scored_steps=32, pattern=AroundTheTank(), warm_up=0,
                      calibration=1),
    prior=Prior(nodal_std=0.0, initial_std=0.5, initial_length=0.02))
"""The evolution model is c⁺ = c with no noise [T]; that neighbours are alike stands in Γ_{0|0} [T],
a smoothness prior. Since the estimate is asked for from the first injection on, ĉ_bh comes from
that injection alone. Two frames of 16 [ours]."""

register(STATIONARY_TANK_2D, "eitbench/StationaryTank2D-v0", about="""
Two metal cylinders stand in a flat round tank of saline; nothing moves. Sixteen electrodes on the
wall, one injection after another: estimate the concentration (which stands for the conductivity)
from the first injection on. A Kalman filter with F = I and a smoothness prior in Γ_{0|0} has found
both cylinders after about five injections (Seppänen 2005, 7.2, Fig. 7.4). Both cylinders are drawn
anew for each episode.
""")
