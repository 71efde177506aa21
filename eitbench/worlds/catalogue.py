"""All built-in environments: their worlds, settings and page text, in the order of the thesis.

[T] marks numbers from the thesis, [E] choices of eitbench.
"""

from dataclasses import replace
from functools import partial
from typing import Any

from eitbench.worlds.bodies import Cylinders, ResistiveDisc, WanderingBody
from eitbench.worlds.flows import (
    FlowPastBulge,
    LaminarFlow,
    NoFlow,
    RandomFlow,
    RandomWalkFlow,
    StirredFlow,
    TurbulentFlow,
)
from eitbench.worlds.instrument import Instrument
from eitbench.worlds.registry import register
from eitbench.worlds.schedule import (
    RotatingRingPattern,
    Schedule,
    SinglePairPattern,
    TankOppositeDiagonalPattern,
)
from eitbench.worlds.slugs import DeadTimePoissonArrivals, Slugs
from eitbench.worlds.vessels import Bulge, PlanePipe, RoundPipe, RoundTank
from eitbench.worlds.world import Prior, World

register_example = partial(register, group="thesis examples")
register_extension = partial(register, group="extensions")
register_injection = partial(register, group="injection", track="injection")

# -- 2D pipe (thesis 5.1) --

PIPE_2D = World("Pipe2D", PlanePipe(), LaminarFlow(), Slugs())
"""A straight plane channel with laminar flow (thesis 5.1.1, Figs 5.1–5.6).

Each time step has one injection. During the 16 injections of a frame the fluid moves 36 cm on
average, almost the length of the pipe.
"""

PIPE_2D_TEXT = """
Fluid flows through a straight 2D pipe, 40 cm long and 10 cm wide, at 4.5 m/s on average. Slugs,
volumes of higher or lower concentration, enter at random times. Sixteen electrodes on the walls
inject one current pattern every 5 ms: during a frame of 16 injections the fluid moves 36 cm. The
task: estimate the concentration field from the voltages of each injection and a flow model
(Seppänen 2005, ch. 5).

The homogeneous estimate has an error of about 0.02, a Kalman filter of about 0.0045.
`assume={"mean_velocity": 4.0}` gives estimators another velocity than the true one.
"""
FIXED_LAG_TEXT = "\nThe task requests the state with a lag of four time steps.\n"
SMOOTHING_TEXT = "\nThe task requests every state after the last measurement.\n"

register_example(PIPE_2D, "eitbench/Pipe2D-v0", description=PIPE_2D_TEXT, is_starting_point=True)
register_example(PIPE_2D, "eitbench/Pipe2DFixedLag-v0", lag=4,
                 description=PIPE_2D_TEXT + FIXED_LAG_TEXT)
register_example(PIPE_2D, "eitbench/Pipe2DSmoothing-v0", lag="all", is_starting_point=True,
                 description=PIPE_2D_TEXT + SMOOTHING_TEXT)

# -- 2D pipe with a wrong mean velocity in the task (5.1.2, Figs 5.7, 5.8) --

PIPE_2D_BIASED = World("Pipe2DBiasedVelocity", PlanePipe(),
                       RandomFlow(velocity_range=(2.5, 7.0)), Slugs())
"""The thesis fixes the true velocity, 4.5 m/s, and varies the assumed one. Here the true velocity
varies, so that methods cannot be tuned to it [E]. Scores: ``docs/velocity.md``."""

register_example(PIPE_2D_BIASED, "eitbench/Pipe2DBiasedVelocity-v0", description="""
The pipe of `eitbench/Pipe2D-v0` with a wrong mean velocity in the task: the task specifies 4.5 m/s,
and the true velocity is drawn for each episode from 2.5 … 7 m/s (Seppänen 2005, 5.1.2, Figs 5.7 and
5.8). The environment measures how much an error of the flow model increases the estimation error.

In the thesis the true velocity is 450 cm/s and the assumed velocity varies:
`gym.make(id, world={"flow": {"velocity_range": [4.5, 4.5]}}, assume={"mean_velocity": 2.0})`.
`assume={"profile": "plug"}` or `"power-law"` (exponent 1/7) selects another profile for the model.
""")

# -- 2D pipe with a parabolic flow of unknown mean --

VELOCITY_TEXT = """
The axial velocity is written as v̂(y) = Σ θ_k φ_k(y/R). `task.velocity` contains the φ_k, the prior
of θ and the rate at which θ may change. The leaderboard shows the errors of concentration and flow,
ẽ_c and ẽ_v, and ranks by ẽ_c.
"""

PIPE_2D_UNKNOWN = World("Pipe2DUnknownVelocity", PlanePipe(),
                        RandomFlow(velocity_range=(3.0, 6.5), profiles="mean"), Slugs())
"""The prior of the mean velocity is 4.5 ± 1 m/s (standard deviation) [E]."""

register_example(PIPE_2D_UNKNOWN, "eitbench/Pipe2DUnknownVelocity-v0", test_seeds="test:0-5",
                 is_starting_point=True, description=f"""
The pipe of `eitbench/Pipe2D-v0` with an unknown parabolic flow, whose mean is drawn for each
episode from 3 … 6.5 m/s. Estimate the concentration and the mean velocity from the voltages
(Seppänen 2005, 6.2, example 1).
{VELOCITY_TEXT}""")

# -- 2D pipe with a mean velocity that changes in time (6.3, Fig. 6.3) --

PIPE_2D_TIME_VARYING = World(
    "Pipe2DTimeVaryingVelocity", PlanePipe(),
    RandomFlow(velocity_range=(3.5, 5.5), oscillation_range=(0.2, 0.35), profiles="mean",
               velocity_walk=0.1), Slugs())
"""A sine of 20 … 35 % about 3.5 … 5.5 m/s; the task's velocity model is a random walk [E]."""

register_example(PIPE_2D_TIME_VARYING, "eitbench/Pipe2DTimeVaryingVelocity-v0",
                 test_seeds="test:0-5", description=f"""
The pipe of `eitbench/Pipe2D-v0` with a parabolic flow whose mean is a sine in time of 20 … 35 %,
drawn for each episode. Estimate the concentration and the mean velocity from the voltages (Seppänen
2005, 6.3, example 2).
{VELOCITY_TEXT}""")

# -- 2D pipe with a non-symmetric flow --

PIPE_2D_SKEWED = World(
    "Pipe2DSkewedVelocity", PlanePipe(),
    RandomFlow(velocity_range=(4.0, 5.0), skewness_range=(0.6, 1.0), profiles="three",
               velocity_walk=0.005), Slugs())
"""The true profile is (1 − η²)·exp(kη), which no combination of the three profiles equals; its
maximum is 0.28 R to 0.41 R off the axis. The steady flow has three parameters [E]."""

register_example(PIPE_2D_SKEWED, "eitbench/Pipe2DSkewedVelocity-v0", test_seeds="test:0-5",
                 description=f"""
The pipe of `eitbench/Pipe2D-v0` with a non-symmetric flow, drawn for each episode. It is estimated
as a combination of three profiles, which cannot represent it exactly: the parabola, a skew cubic,
and a quartic that flattens or sharpens the profile without a net flux (Seppänen 2005, 6.4, example
3).
{VELOCITY_TEXT}""")

# -- 2D pipe with a bulge in its lower wall --

PIPE_2D_OBSTACLE = World("Pipe2DObstacle", PlanePipe(bulge=Bulge()), FlowPastBulge(), Slugs())
"""Behind the bulge the fluid recirculates over more than half of the pipe. All numbers [E]."""

register_extension(PIPE_2D_OBSTACLE, "eitbench/Pipe2DObstacle-v0", description="""
The pipe of `eitbench/Pipe2D-v0` with a bulge in its lower wall. The flow separates behind the bulge
and recirculates; it solves the steady Navier–Stokes equations. The task contains the exact walls
and a flow model that is a parabola between them at each x; `assume={"flow": "real"}` selects the
true flow. The environment measures the loss by the simple model of the thesis and the benefit of a
better one (Seppänen 2005, 5.1.1, names better fluid models as the next step).
""")

# -- 2D pipe with turbulent fluctuations of the velocity --

PIPE_2D_TURBULENT = World("Pipe2DTurbulent", PlanePipe(), TurbulentFlow(), Slugs())
"""Kinematic simulation with 40 random modes; all numbers of the fluctuations [E]."""

register_extension(PIPE_2D_TURBULENT, "eitbench/Pipe2DTurbulent-v0", description="""
The pipe of `eitbench/Pipe2D-v0` with turbulent fluctuations of the velocity, drawn for each
episode. Eddies deform the slugs on their way through the pipe. The task specifies the mean flow
only, a parabola, so that filters have an error of the flow that changes in space and time. The
thesis assumes laminar flow and notes that this does not hold at its Reynolds number (Seppänen 2005,
5.1). `true_model_smoother` receives the true flow.

The rms of a component of the fluctuations is 10 % of the mean velocity. The fluctuations have no
divergence, vanish at the walls, and have the integral scale R/2; the mean flow convects them, and
each eddy decorrelates within its turnover time (`docs/turbulence.md`).
`world={"flow": {"intensity": 0.05}}` changes the intensity, and
`world={"flow": {"profile": "power-law"}}` the mean profile, also the profile in the task.
""")

# -- Robustness variants of the 2D pipe --

NOMINAL_ID = "eitbench/Pipe2D-v0"
VARIANT_TEXT = f"""
Everything else is as in `{NOMINAL_ID}`, and the task is the same: it specifies the same model,
noise and velocity, and methods trained for that pipe are compatible. The robustness table compares
the scores in both (`docs/robustness.md`). `true_model_smoother` receives the true flow; other
changes are hidden from it.
"""


def register_variant(name: str, description: str, **parts: Any) -> World:
    """Register the nominal pipe with other ``parts`` (fields of `World`); return the new world."""
    world = replace(PIPE_2D, **parts)
    if world.truth_config != PIPE_2D.truth_config:  # else it shares episodes with the nominal one
        world = replace(world, name=name)
    register(world, f"eitbench/{name}-v0", nominal=NOMINAL_ID, group="robustness variants",
             description=description + VARIANT_TEXT)
    return world


PIPE_2D_SHORT_SLUGS = register_variant(
    "Pipe2DShortSlugs", target=Slugs(time_std=(3e-3, 7e-3)), description="""
Slugs pass in half the time: the standard deviation of a slug is 3 to 7 ms, in the nominal
environment 6 to 14 ms. Priors that assume slow changes of the inflow are wrong sooner.
""")

PIPE_2D_STRONG_SLUGS = register_variant(
    "Pipe2DStrongSlugs", target=Slugs(log_amplitude=(0.33, 0.60)), description="""
Slugs are 1.5 times as strong: at its centre a slug changes the logarithm of the concentration by
0.33 to 0.60, in the nominal environment by 0.22 to 0.40. Voltages are less linear in this range,
and priors expect smaller changes.
""")

PIPE_2D_DOUBLE_NOISE = register_variant(
    "Pipe2DDoubleNoise", instrument=Instrument(noise_mismatch=2.0), description="""
The measurement noise is twice the noise in the task. The concentration of each episode is
the same as in the nominal environment.
""")

PIPE_2D_OTHER_VELOCITY = register_variant(
    "Pipe2DOtherVelocity", flow=RandomFlow(velocity_range=(4.05, 4.95)), description="""
The mean velocity, 4.5 m/s in the task, is drawn for each episode within 10 % of that, from 4.05 to
4.95 m/s. In `eitbench/Pipe2DBiasedVelocity-v0` the range is 2.5 to 7 m/s.
""")

PIPE_2D_OTHER_CONTACTS = register_variant(
    "Pipe2DOtherContacts", instrument=Instrument(contact_impedance_spread=0.5), description="""
The contact impedance of each electrode is drawn for each episode within 50 % of the value in the
task, from 1 to 3 mΩ·m². Voltages follow the complete electrode model with these impedances.
""")

PIPE_2D_OTHER_INLET = register_variant(
    "Pipe2DOtherInlet", target=Slugs(transverse_std=(6e-3, 9e-3), radial_range=(0.7, 0.95)),
    description="""
Slugs are narrow and enter near the walls, where the fluid is slow: their centres are 0.7 to 0.95 R
from the axis, in the nominal environment 0 to 0.7 R, and their transverse standard deviation is 6
to 9 mm, in the nominal environment 10 to 25 mm.
""")

# -- 3D pipe (5.2, Fig. 5.10) --

PIPE_3D = World("Pipe3D", RoundPipe(), LaminarFlow(), Slugs(),
                schedule=Schedule(scored_steps=48, pattern=RotatingRingPattern()))
"""The available excerpt of thesis 5.2 has the figure only; times, velocity and noise are taken from
the 2D pipe of the thesis. Three frames are scored [E]."""

PIPE_3D_TEXT = """
Fluid flows through a round pipe, 40 cm long and 10 cm wide, at 4.5 m/s on average; slugs of higher
or lower concentration enter at random times. Four rings of eight electrodes on the wall inject one
current pattern every 5 ms. Estimate the concentration field from the voltages of each injection and
a flow model (Seppänen 2005, 5.2, Fig. 5.10).

The first use of a seed simulates its ground truth (one to two minutes) and stores it in the cache;
`eitbench bank` simulates many seeds in advance.
"""

register_example(PIPE_3D, "eitbench/Pipe3D-v0", test_seeds="test:0-5", is_starting_point=True,
                 description=PIPE_3D_TEXT)
register_example(PIPE_3D, "eitbench/Pipe3DSmoothing-v0", test_seeds="test:0-5", lag="all",
                 description=PIPE_3D_TEXT + SMOOTHING_TEXT)

# -- Stirred tank (thesis 7.1) --

ROTATING_TANK_2D = World(
    "RotatingTank2D", RoundTank(), StirredFlow(), ResistiveDisc(),
    schedule=Schedule(time_step=0.025, scored_steps=64, pattern=SinglePairPattern(), warm_up=16),
    prior=Prior(nodal_std=0.15, initial_std=0.25, initial_length=0.02))
"""The thesis gives neither sizes nor times: all numbers [E]. The model has no ball, as in the
thesis. With the pipe's nodal noise of 0.02 a filter underestimates this model error, and loses a
disc near the stirrer's circle, where the flow shears most (dev episodes; ``docs/tanks.md``)."""

register_example(ROTATING_TANK_2D, "eitbench/RotatingTank2D-v0", description="""
The flow in a flat round tank of stirred saline carries a ball with a low conductivity; sixteen
electrodes are on the wall, and one pair of them injects all the time. A stationary image of one
injection shows nothing, but the flow carries the target through the field of the pair, and a filter
with a flow model can track it (Seppänen 2005, 7.1, Figs 7.2 and 7.3).

The truth is a rigid ball that does not follow the liquid; the model in `env.unwrapped.task` is a
liquid without a ball, in which concentration is advected and diffuses, as in the thesis. The ball
starts between 0.25 and 0.48 of the radius from the centre, at any angle; the flow is steady.
""")

# -- Stationary tank (thesis 7.2) --

STATIONARY_TANK_2D = World(
    "StationaryTank2D", RoundTank(), NoFlow(), Cylinders(),
    schedule=Schedule(time_step=0.02, scored_steps=32, pattern=TankOppositeDiagonalPattern(),
                      warm_up=0, calibration=1),
    prior=Prior(nodal_std=0.0, initial_std=0.5, initial_length=0.02))
"""The evolution model is c⁺ = c without noise [T]; Γ_{0|0} is a smoothness prior [T]. Scores begin
with the first injection, so ĉ_bh is fitted to that injection alone. Two frames of 16 [E]."""

register_example(STATIONARY_TANK_2D, "eitbench/StationaryTank2D-v0", is_starting_point=True,
                 description="""
Two stationary metal cylinders are in a flat round tank of saline. Sixteen electrodes on the wall
inject one current pattern after another: estimate the concentration (which represents the
conductivity) from the first injection on. A Kalman filter with F = I and a smoothness prior in
Γ_{0|0} finds both cylinders after about five injections (Seppänen 2005, 7.2, Fig. 7.4). Both
cylinders are drawn for each episode.
""")

# -- 2D pipe in which an agent injects --

PIPE_2D_CURRENTS = World("Pipe2D", PIPE_2D.vessel, PIPE_2D.flow, PIPE_2D.target,
                         Instrument(noise_floor=2e-4, current_norm="Linf"))
"""One current source per electrode; because of the noise floor the amplitude matters [E]."""

INJECTION_TEXT = """
The pipe of `eitbench/Pipe2D-v0`, where the agent chooses the current pattern at every step. A
Kalman filter inside the environment processes the voltages and estimates the concentration. All
agents use the same filter, so that they differ only in their injections.
"""

register_injection(PIPE_2D, "eitbench/Pipe2DInjection-v0", is_reference=True,
                   description=f"""{INJECTION_TEXT}
This environment is a reference case, not a competition: no policy is better than one pair near the
inlet, injected all the time (the flow carries the information from the inlet through the whole
pipe), and the best injection does not depend on the data. The normalised adaptivity gap is zero
(`docs/injection.md`).
""")
register_injection(PIPE_2D, "eitbench/Pipe2DInjectionInflow-v0", inflow="learned",
                   is_reference=True, description=f"""{INJECTION_TEXT}
The filter uses a prior of duration and width of slugs that is fitted to training inflows
(`docs/methods.md`, 10), and linearises about each prediction; in `eitbench/Pipe2DInjection-v0` its
inflow is white noise, Table 5.1. With the best pair at the inlet the error is one seventh of the
error there. This environment is a reference case too: the normalised adaptivity gap is zero
(`docs/injection.md`).
""")
register_injection(PIPE_2D_CURRENTS, "eitbench/Pipe2DInjectionCurrents-v0", is_reference=True,
                   description=f"""{INJECTION_TEXT}
The action is a current for each electrode. This environment is a reference case: the best currents,
the same at every step, reduce ẽ_c by a tenth relative to pairs; the clairvoyant policy is not
significantly better. The normalised adaptivity gap is zero.

Actions are relative to the instrument's 0.1 A/m. Entries are clipped to ±1; their mean is
subtracted (Σ I = 0); if the result exceeds the norm of a pair, it is scaled down to it. The norm is
Σ|I| ≤ 2 ("L1", a total current), Σ I² ≤ 2 ("L2", a power) or |I| ≤ 1 ("Linf", a source for each
electrode): `world={{"instrument": {{"current_norm": "L1"}}}}`.
""")

# -- 2D pipe with a faulty instrument --

PIPE_2D_FAULTS = World(
    "Pipe2D", PIPE_2D.vessel, PIPE_2D.flow, PIPE_2D.target,
    Instrument(noise_floor=1e-4, interference=0.5, n_dead_range=(2, 4), n_failing_range=(1, 2),
               n_loose_range=(0, 2)))
"""A bad contact adds 0.5 to 2 Ω·m (an intact one has 0.08) and has five times the noise [E]."""

register_injection(PIPE_2D_FAULTS, "eitbench/Pipe2DInjectionFaults-v0", test_seeds="test:0-49",
                   gate=8.0, description="""
`eitbench/Pipe2DInjection-v0` with a faulty instrument. In every episode other electrodes are dead
from the beginning, fail during the episode, or have a bad contact; the task does not specify which.
A current through a broken wire does not flow, and the measurement at such an electrode is
interference, 0.5 V (std), about as much as the largest voltages. The filter inside rejects
measurements that differ by more than 8 standard deviations (`gate`) from its prediction, and a
whole injection if it rejects more than a third of its measurements.

The best pair depends on the episode, and the measurements indicate it (`doubt` and `innovations`
show the broken electrodes): the normalised adaptivity gap is 0.52, with a 95 % interval from
0.28 to 0.82 over the 50 episodes of the leaderboard (`docs/injection.md`).
""")

# -- 2D pipe with rare slugs --

PIPE_2D_INTERMITTENT = World(
    "Pipe2DIntermittent", PlanePipe(), LaminarFlow(),
    Slugs(log_amplitude=(0.35, 0.60),
          arrivals=DeadTimePoissonArrivals(dead_time=0.10, mean_wait=0.20)),
    schedule=Schedule(scored_steps=180))
"""Strong slugs, about three in the scored injections; all numbers [E]."""
PIPE_2D_BUDGET = replace(PIPE_2D_INTERMITTENT,
                         schedule=replace(PIPE_2D_INTERMITTENT.schedule, budget=30))
"""The same episodes; the agent has a budget of 30 injections, one sixth of the scored steps."""

register_extension(PIPE_2D_INTERMITTENT, "eitbench/Pipe2DIntermittent-v0", test_seeds="test:0-15",
                   description="""
The pipe of `eitbench/Pipe2D-v0` with rare slugs: strong slugs come one at a time, at random times,
about three in an episode. Between them the inflow is constant. A Gaussian prior of the inflow
assigns a moderate variance to every step; a method that detects slugs can use a small variance
between them and a large one during a slug. The episodes are the same as in
`eitbench/Pipe2DInjectionBudget-v0`, with an injection at every step.
""")
register_injection(PIPE_2D_BUDGET, "eitbench/Pipe2DInjectionInflowBudget-v0",
                   test_seeds="test:0-49", inflow="learned", description="""
The rare slugs and the budget of `eitbench/Pipe2DInjectionBudget-v0`, with the filter of
`eitbench/Pipe2DInjectionInflow-v0`, whose inflow prior is fitted to training inflows. On the
episodes dev:0-7 the normalised adaptivity gap is 0.45, with a 95 % interval from 0.34 to 0.62
(`docs/injection.md`).
""")
register_injection(PIPE_2D_BUDGET, "eitbench/Pipe2DInjectionBudget-v0", test_seeds="test:0-49",
                   is_starting_point=True, description="""
The pipe of `eitbench/Pipe2D-v0` with rare slugs: strong slugs come one at a time, at random times,
about three in an episode. The agent may inject in one step of six, so it has to detect a slug, then
inject often, and save injections for the next one. When the budget is used up, actions do not
inject (`action_masks`); injections within the budget cost nothing. In a step without injection
`voltages` are the amplifiers' noise (zero here) and `innovations` are zero. The first frame does
not count against the budget.

The normalised adaptivity gap is 0.51, with a 95 % interval from 0.45 to 0.57 over the 50 episodes
of the leaderboard (`docs/injection.md`).
""")

# -- 2D pipe with a mean velocity that drifts --

PIPE_2D_DRIFTING = World("Pipe2DDriftingVelocity", PlanePipe(), RandomWalkFlow(), Slugs(),
                         region=(0.28, 0.40))
"""Errors are integrated over the last 12 cm of the pipe; all numbers [E]."""

register_injection(PIPE_2D_DRIFTING, "eitbench/Pipe2DInjectionFlow-v0", test_seeds="test:0-29",
                   description="""
The pipe of `eitbench/Pipe2D-v0` with an unknown mean velocity that drifts, a random walk between
2.5 and 6.5 m/s. Errors are integrated over a region of interest, by default the last 12 cm
(`world={"region": null}`: the whole pipe). The filter inside estimates concentration and mean
velocity together (the joint extended Kalman filter of the thesis' chapter 6), from 4.5 ± 1 m/s. The
agent may observe slugs at the inlet, on their way or in the region; the position of a slug that has
entered is as uncertain as the velocity that carries it.

This environment is a competition: the normalised adaptivity gap is 1.04, with a 95 % interval
from 0.70 to 1.96 over the 30 episodes of the leaderboard. No hand-written adaptive policy
outperforms random pairs, which are as good as the best cycle; trained agents do
(`docs/injection.md`).
""")

# -- Stirred tank in which an agent injects --

register_injection(ROTATING_TANK_2D, "eitbench/RotatingTankInjection-v0", is_reference=True,
                   description="""
The stirred tank of `eitbench/RotatingTank2D-v0`: the flow carries a ball with a low conductivity on
an unknown path, and the agent chooses the pair of electrodes that injects. The filter inside has
the flow of the liquid and no model of the ball. The first frame is one injection of 0 → 8.

This environment is a reference case, not a competition: the liquid carries the ball past every
pair, the clairvoyant policy improves ẽ_c by 8 % over random pairs, and no adaptive policy
outperforms the best pair. The normalised adaptivity gap is 0.25, with a 95 % interval from 0.05 to
0.40 over the 10 episodes of the leaderboard, a quotient of small numbers (`docs/injection.md`).
""")

# -- Tank with a body that moves by itself --

TANK_TRACKING = World(
    "TankTracking", RoundTank(truth_refinement=2), NoFlow(), WanderingBody(),
    Instrument(noise_relative=3e-3, noise_relative_to_max=3e-4, readings="neighbours"),
    Schedule(time_step=0.025, scored_steps=92, pattern=TankOppositeDiagonalPattern(), warm_up=20),
    Prior(expected_concentration=30.0))
"""The concentration of the liquid is known, as in difference imaging. The mesh of the truth changes
voltages by 0.1 standard deviations of the noise (median of the pairs), near the wall by up to 0.8
(``tests/worlds/test_wandering_body.py``). All numbers [E]."""
SEARCH_AND_TRACK = replace(TANK_TRACKING, name="SearchAndTrack",
                           target=WanderingBody(visit_time=1.0))

TRACKING_TEXT = """
The liquid is at rest, and a plastic body with a radius of 14 to 18 mm moves by itself in the tank:
it runs straight ahead at 0.1 to 0.3 m/s and turns at random times, 0.4 s apart in the mean. A
serial instrument injects through one pair of electrodes every 25 ms and measures only the
electrodes next to the driven ones, four at most. Its sensitivity is local, so that the current
should enter near the body.

The filter inside is a particle filter of position, velocity and size of the body, with another
motion than the true one (an Ornstein–Uhlenbeck velocity). The estimate is the mean image of the
particles; reward and ẽ_c are computed from the image, as in the other environments. The
concentration of the liquid is known. Voltages that are not measured are zero in the observation.
"""

WANDERING_BODY_2D = replace(TANK_TRACKING, name="WanderingBody2D",
                            instrument=replace(TANK_TRACKING.instrument, readings="all"))

register_example(WANDERING_BODY_2D, "eitbench/WanderingBody2D-v0", description="""
A plastic body with a radius of 14 to 18 mm moves by itself in a tank of liquid at rest: it runs
straight ahead at 0.1 to 0.3 m/s and turns at random times, 0.4 s apart in the mean. Sixteen
electrodes are measured in every injection, 25 ms apart; in a frame of sixteen injections the body
moves by several radii. It is the body of `eitbench/TankTracking-v0`, with all voltages and without
a choice of the injection.

Sizes, speeds and conductivity of the body are in `env.unwrapped.task.body`, its motion in an
episode is not. A filter of its position has few unknowns; an image has one for each node, and no
model of what moves.
""")

register_injection(TANK_TRACKING, "eitbench/TankTracking-v0", test_seeds="test:0-49",
                   is_starting_point=True, description=f"""
Follow a body that moves by itself, with a few measurements of each injection. This environment is
a competition: the error of the best hand-written adaptive policy is 0.63 times the error of the
best cycle, with a 95 % interval from 0.59 to 0.67 over the 50 episodes of the leaderboard
(`docs/injection.md`).
{TRACKING_TEXT}""")
register_injection(SEARCH_AND_TRACK, "eitbench/SearchAndTrack-v0", test_seeds="test:0-49",
                   description=f"""
Detect a body that comes and goes without notice, and follow it while it is there. It stays for 1 s
and is absent for 0.5 s, both in the mean and exponentially distributed; it returns anywhere. A
policy has to search while the tank seems empty, and to track the body afterwards. The error of the
best hand-written adaptive policy is 0.74 times the error of the best cycle, with a 95 % interval
from 0.64 to 0.85 (`docs/injection.md`).
{TRACKING_TEXT}""")
