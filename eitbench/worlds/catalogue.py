"""All registered environments: their worlds, settings and page text, in the order of the thesis.

[T] marks numbers of the thesis, [ours] the project's own choices.
"""

from dataclasses import replace
from typing import Any

from eitbench.worlds.bodies import Ball, Cylinders
from eitbench.worlds.flows import (
    DrawnFlow,
    FlowPastBulge,
    LaminarFlow,
    NoFlow,
    StirredFlow,
    WanderingFlow,
)
from eitbench.worlds.instrument import Instrument
from eitbench.worlds.registry import register
from eitbench.worlds.schedule import AroundTheTank, OnePair, RingsInTurn, Schedule
from eitbench.worlds.slugs import NowAndThen, Slugs
from eitbench.worlds.vessels import Bulge, PlanePipe, RoundPipe, RoundTank
from eitbench.worlds.world import Prior, World

# -- 2D pipe (thesis 5.1) --

PIPE_2D = World("Pipe2D", PlanePipe(), LaminarFlow(), Slugs())
"""A straight plane channel with laminar flow (thesis 5.1.1, Figs 5.1–5.6).

One injection a time step; in the 16 injections of a frame the fluid moves 36 cm on average, almost
the whole pipe.
"""

PIPE_2D_ABOUT = """
Fluid streams through a straight 2D pipe, 40 cm long and 10 cm wide, at 4.5 m/s on average; slugs of
higher and lower concentration enter at random. Sixteen electrodes on the walls, one current
injection every 5 ms: while a frame of 16 injections is measured, the fluid moves on by 36 cm. From
the voltages of each injection, and a model of flow, estimate the concentration everywhere (Seppänen
2005, ch. 5).

The homogeneous estimate scores about 0.02, a Kalman filter about 0.0045.
`assume={"mean_velocity": 4.0}` tells estimators another velocity than the true one.
"""
LAGGED = "\nHere the state of four injections before is asked for.\n"
WHOLE = "\nHere every state is asked for, once the whole record has been played.\n"

register(PIPE_2D, "eitbench/Pipe2D-v0", about=PIPE_2D_ABOUT)
register(PIPE_2D, "eitbench/Pipe2DFixedLag-v0", about=PIPE_2D_ABOUT + LAGGED, lag=4)
register(PIPE_2D, "eitbench/Pipe2DSmoothing-v0", about=PIPE_2D_ABOUT + WHOLE, lag="all")

# -- 2D pipe with another mean velocity than estimators assume (5.1.2, Figs 5.7, 5.8) --

PIPE_2D_BIASED = World("Pipe2DBiasedVelocity", PlanePipe(),
                       DrawnFlow(velocity_range=(2.5, 7.0)), Slugs())
"""The thesis keeps the truth at 4.5 m/s and varies what is assumed; so that nobody gains by knowing
the one true velocity, here the truth varies [ours]. What methods score: ``docs/velocity.md``."""

register(PIPE_2D_BIASED, "eitbench/Pipe2DBiasedVelocity-v0", about="""
The pipe of `eitbench/Pipe2D-v0`, but the mean velocity that estimators are told, 4.5 m/s, is not
the true one, which is drawn for each episode from 2.5 … 7 m/s (Seppänen 2005, 5.1.2, Figs 5.7 and
5.8). How much does a method suffer from a wrong model of the flow?

In the thesis the truth is 450 cm/s and the assumed velocity varies; that is
`gym.make(id, world={"flow": {"velocity_range": [4.5, 4.5]}}, assume={"mean_velocity": 2.0})` here.
`assume={"profile": "plug"}` or `"power-law"` (exponent 1/7) lets the model believe in another
profile.
""")

# -- 2D pipe with a parabolic flow of unknown mean --

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

# -- 2D pipe with a mean velocity that changes in time (6.3, Fig. 6.3) --

PIPE_2D_TIME_VARYING = World(
    "Pipe2DTimeVaryingVelocity", PlanePipe(),
    DrawnFlow(velocity_range=(3.5, 5.5), swing_range=(0.2, 0.35), profiles="mean",
              velocity_walk=0.1), Slugs())
"""A sine of 20 … 35 % about 3.5 … 5.5 m/s; estimators are told that the flow changes [ours]."""

register(PIPE_2D_TIME_VARYING, "eitbench/Pipe2DTimeVaryingVelocity-v0", seeds="test:0-5", about=f"""
The pipe of `eitbench/Pipe2D-v0` with a parabolic flow whose mean is a sine in time of 20 … 35 %,
drawn for each episode. Estimate the concentration and the mean velocity from the voltages (Seppänen
2005, 6.3, example 2).
{ASKED}""")

# -- 2D pipe with a non-symmetric flow --

PIPE_2D_SKEWED = World(
    "Pipe2DSkewedVelocity", PlanePipe(),
    DrawnFlow(velocity_range=(4.0, 5.0), skewness_range=(0.6, 1.0), profiles="three",
              velocity_walk=0.005), Slugs())
"""The truth is (1 − η²)·exp(kη), which no combination of the three profiles equals: the fastest
fluid is 0.28 R to 0.41 R off the axis. Of a steady flow three numbers are to be told [ours]."""

register(PIPE_2D_SKEWED, "eitbench/Pipe2DSkewedVelocity-v0", seeds="test:0-5", about=f"""
The pipe of `eitbench/Pipe2D-v0` with a flow that is not symmetric, drawn for each episode. It is
estimated as a combination of three profiles, of which none equals it: the parabola, a skew cubic,
and a quartic that flattens or sharpens the profile without a net flux (Seppänen 2005, 6.4, example
3).
{ASKED}""")

# -- The 2D pipe with a dent in its lower wall --

PIPE_2D_OBSTACLE = World("Pipe2DObstacle", PlanePipe(bulge=Bulge()), FlowPastBulge(), Slugs())
"""Behind the bulge the fluid recirculates over more than half of the pipe. All numbers are ours."""

register(PIPE_2D_OBSTACLE, "eitbench/Pipe2DObstacle-v0", about="""
The pipe of `eitbench/Pipe2D-v0` with a bulge in its lower wall. The flow separates behind it and
recirculates; it solves the steady Navier–Stokes equations. Estimators know the walls, but their
model assumes a parabola between them at each place; with `assume={"flow": "real"}` they are given
the real flow. How far does the simple model of the thesis carry, and what is gained by a better one
(Seppänen 2005, 5.1.1, names better fluid models as the next step)?
""")

# -- Robustness variants of the 2D pipe --

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

# -- 3D pipe (5.2, Fig. 5.10) --

PIPE_3D = World("Pipe3D", RoundPipe(), LaminarFlow(), Slugs(),
                schedule=Schedule(scored_steps=48, pattern=RingsInTurn()))
"""The page at hand shows the figure only: times, velocity and noise are those of the thesis' 2D
pipe. Three frames are scored [ours]."""

PIPE_3D_ABOUT = """
Fluid streams through a round pipe, 40 cm long and 10 cm wide, at 4.5 m/s on average; slugs of
higher and lower concentration enter at random. Four rings of eight electrodes on the wall, one
current injection every 5 ms. From the voltages of each injection, and a model of flow, estimate the
concentration everywhere (Seppänen 2005, 5.2, Fig. 5.10).

The first use of a seed simulates its truth (one to two minutes), which is then kept on disk;
`eitbench bank` does so for many seeds ahead of time.
"""

register(PIPE_3D, "eitbench/Pipe3D-v0", seeds="test:0-5", about=PIPE_3D_ABOUT)
register(PIPE_3D, "eitbench/Pipe3DSmoothing-v0", seeds="test:0-5", lag="all",
         about=PIPE_3D_ABOUT + WHOLE)

# -- The stirred tank (thesis 7.1) --

ROTATING_TANK_2D = World(
    "RotatingTank2D", RoundTank(), StirredFlow(), Ball(),
    schedule=Schedule(time_step=0.025, scored_steps=64, pattern=OnePair(), warm_up=16),
    prior=Prior(nodal_std=0.15, initial_std=0.25, initial_length=0.02))
"""The thesis gives neither sizes nor times: all numbers are ours. The pipe's nodal noise of 0.02
trusts the model, which is wrong as in the thesis, so far that a ball near the stirrer's circle,
where the flow shears most, is lost (dev episodes; ``docs/tanks.md``)."""

register(ROTATING_TANK_2D, "eitbench/RotatingTank2D-v0", about="""
A flat round tank of stirred saline carries a ball round that hardly conducts; sixteen electrodes on
the wall. One pair of them injects all the time. A stationary image of one injection shows nothing,
but the flow carries the target through the pair's field, and a filter that knows the flow can
follow it (Seppänen 2005, 7.1, Figs 7.2 and 7.3).

The truth is a rigid ball on a path of its own; the model in `env.unwrapped.task` is a liquid
without any ball, in which concentration is carried and spreads, as in the thesis. The ball begins
between 0.25 and 0.48 of the radius from the middle, at any angle; the flow is steady.
""")

# -- The tank at rest (thesis 7.2) --

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

# -- 2D pipe in which an agent injects --

PIPE_2D_CURRENTS = World("Pipe2D", PIPE_2D.vessel, PIPE_2D.flow, PIPE_2D.target,
                         Instrument(noise_floor=2e-4, limit="Linf"))
"""A source for each electrode; with relative noise alone the amplitude would not matter [ours]."""

INJECTION_ABOUT = """
The pipe of `eitbench/Pipe2D-v0`; here the agent chooses at every step how the current flows. A
Kalman filter inside takes in the voltages and estimates the concentration; it is the same for every
agent, so that agents differ only in what they inject.
"""

register(PIPE_2D, "eitbench/Pipe2DInjection-v0", track="injection", about=f"""{INJECTION_ABOUT}
This is the reference case, not a competition: one pair near the inlet, injected for ever, is as
good as anything (what is known at the inlet the flow carries through the whole pipe), and what to
inject does not depend on what is measured. The adaptivity gap is none (`docs/injection.md`).
""")
register(PIPE_2D, "eitbench/Pipe2DInjectionInflow-v0", track="injection", inflow="learned",
         about=f"""{INJECTION_ABOUT}
Here the filter has learned from training inflows how slugs last and how wide they are
(`docs/methods.md`, 10), and linearises about each prediction; in `eitbench/Pipe2DInjection-v0` it
takes them for white noise, Table 5.1. With the best pair at the inlet the error is a seventh of
what it is there, and this is as much a reference: the adaptivity gap is none (`docs/injection.md`).
""")
register(PIPE_2D_CURRENTS, "eitbench/Pipe2DInjectionCurrents-v0", track="injection",
         about=f"""{INJECTION_ABOUT}
This is the same world with a current of its own for each electrode, and as much a reference: the
best currents, the same at every step, take a tenth off the ẽ_c of any pairs, and the clairvoyant 2
% more. The adaptivity gap is none.

Actions are in parts of the instrument's 0.1 A/m. Entries beyond ±1 are first cut to ±1; then their
mean is taken away (Σ I = 0); if they still exceed the limit, they are scaled down to it. The limit
is the norm of a pair: Σ|I| ≤ 2 ("L1", a total current), Σ I² ≤ 2 ("L2", a power) or |I| ≤ 1
("Linf", a source for each electrode):
`world={{"instrument": {{"limit": "L1"}}}}`.
""")

# -- 2D pipe with an instrument that is falling apart --

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

# -- 2D pipe when slugs are rare --

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

# -- 2D pipe with a mean velocity that wanders --

PIPE_2D_DRIFTING = World("Pipe2DDriftingVelocity", PlanePipe(), WanderingFlow(), Slugs(),
                         region=(0.28, 0.40))
"""Errors are counted between two cross-sections; all numbers are ours."""

register(PIPE_2D_DRIFTING, "eitbench/Pipe2DInjectionFlow-v0", track="injection",
         seeds="test:0-29", about="""
The pipe of `eitbench/Pipe2D-v0` with a mean velocity that nobody knows and that drifts, a random
walk between 2.5 and 6.5 m/s. Only what flows through a region of interest counts, by default the
last 12 cm (`world={"region": null}`: the whole pipe). The filter inside estimates concentration and
mean velocity together (the joint extended Kalman filter of the thesis' chapter 6), from 4.5 ± 1
m/s. Slugs may be looked at when they enter, on the way or when they arrive; what is known of one
that has entered is worth no more than what is known of the flow that carries it.

This is a competition case: the adaptivity gap is 1.04, with a 95 % interval from 0.70 to 1.96 over
the board's 30 episodes. No hand-written policy that looks at the data has beaten random pairs,
which are as good as the best cycle; trained agents do (`docs/injection.md`).
""")

# -- The stirred tank in which an agent chooses what to inject --

register(ROTATING_TANK_2D, "eitbench/RotatingTankInjection-v0", track="injection", about="""
The stirred tank of `eitbench/RotatingTank2D-v0`: a ball that hardly conducts is carried round on a
path that nobody knows beforehand. Here the agent chooses which pair of electrodes injects. The
filter inside knows the liquid's flow and of no ball. The first frame is one injection of 0 → 8.

This is a reference case, not a competition: the liquid carries the ball past every pair, between
random pairs and the clairvoyant there are 8 % of ẽ_c, and no policy that looks at the data has
beaten the best pair. The adaptivity gap is 0.25, with a 95 % interval from 0.05 to 0.40 over the
board's 10 episodes, a quotient of small numbers (`docs/injection.md`).
""")
