"""A short world for each id: guarantees do not depend on the length of an episode."""

from dataclasses import replace

from eitbench.data.episodes import cached_truth_model
from eitbench.worlds import entries, entry, registry
from eitbench.worlds.bodies import MovingBody
from eitbench.worlds.catalogue import PIPE_2D
from eitbench.worlds.random_streams import episode_streams

PLAIN = [name for name, each in entries().items() if each.world == PIPE_2D]
"""Ids with the thesis' pipe as it is."""


def merged(*changes: dict) -> dict:
    """Merge overrides of a world by component."""
    result: dict = {}
    for each in changes:
        for name, value in each.items():
            both = isinstance(value, dict) and isinstance(result.get(name), dict)
            result[name] = merged(result[name], value) if both else value
    return result


FAST = {"flow": {"mean_velocity": 45.0}, "schedule": {"scored_steps": 3, "pattern": {"frame": 2}},
        "vessel": {"electrodes_per_wall": 2}}
"""A fast fluid flushes the pipe in two steps: five measurements, the last three states are scored."""
TINY = PIPE_2D.with_changes(FAST)
DRAWN = merged(FAST, {"flow": {"velocity_range": [40.0, 50.0]}})
WANDERING = merged(DRAWN, {"region": [0.28, 0.40], "schedule": {"scored_steps": 5}})
TANK = {"vessel": {"n_electrodes": 8}, "schedule": {"warm_up": 1, "scored_steps": 4}}
ROUND = {"flow": {"mean_velocity": 45.0}, "schedule": {"scored_steps": 3, "pattern": {"frame": 2}},
         "vessel": {"potential_order": 1, "electrode_rings": 1, "electrodes_per_ring": 4}}

SHORT = {
    "Pipe2D": FAST,
    "Pipe2DIntermittent": merged(FAST, {"target": {"arrivals": {"dead_time": 0.01, "mean_wait": 0.001}}}),
    "Pipe2DBiasedVelocity": DRAWN,
    "Pipe2DUnknownVelocity": DRAWN,
    "Pipe2DTimeVaryingVelocity": DRAWN,
    "Pipe2DSkewedVelocity": DRAWN,
    "Pipe2DObstacle": merged(FAST, {"flow": {"viscosity": 0.04}, "vessel": {"bulge": {"height": 0.01}}}),
    "Pipe2DTurbulent": merged(FAST, {"flow": {"intensity": 0.02, "n_modes": 4}}),
    "Pipe2DShortSlugs": FAST,
    "Pipe2DStrongSlugs": FAST,
    "Pipe2DOtherVelocity": DRAWN,
    "Pipe2DOtherContacts": FAST,
    "Pipe2DOtherInlet": FAST,
    "Pipe3D": ROUND,
    "Pipe3DUnknownVelocity": merged(ROUND, {"flow": {"velocity_range": [30.0, 65.0]}}),
    "RotatingTank2D": TANK,
    "StationaryTank2D": {"vessel": {"n_electrodes": 8}, "schedule": {"scored_steps": 5}},
    "PipeInjection": {"schedule": {"scored_steps": 4}},
    "TankTracking": {"schedule": {"scored_steps": 4}},
    "WanderingBody2D": TANK,
    "SearchAndTrack": {"schedule": {"scored_steps": 4}},
    "BubbleTracking": {"schedule": {"scored_steps": 4}},
    "TwoBubbleTracking": {"schedule": {"scored_steps": 4}},
    "RisingBubbles2D": {"schedule": {"warm_up": 1, "scored_steps": 4}},
    "TwoBubbles2D": {"schedule": {"warm_up": 1, "scored_steps": 4}},
    "TankInjection": {"schedule": {"warm_up": 2, "scored_steps": 3}},
}
"""Name of a world -> overrides for short episodes. Worlds of the track injection keep vessel and flow, for which the
package ships reduced filters; the agent has six steps in a pipe, the last four of them scored."""


def world(name: str) -> dict:
    """Return keyword arguments for short episodes of an id."""
    each = entry(name)
    kind = each.world.name
    if each.track == "injection" and not isinstance(each.world.target, MovingBody):
        kind = "TankInjection" if kind == "RotatingTank2D" else "PipeInjection"
    assert kind in SHORT, f"{name} has no short version yet: give {kind!r} one in tests/short.py"
    return {"world": SHORT[kind]}


def truths(world, *seeds):
    """Simulate the concentrations and velocities of episodes together, without voltages."""
    streams = [episode_streams(seed) for seed in seeds]
    return list(world.target.evolve(world, streams, cached_truth_model(world), lambda _: None, world.n_steps))


def short(name: str) -> dict:
    """Return keyword arguments for short episodes and few training episodes."""
    return world(name) | {"episodes": 2}


def register_apart(monkeypatch) -> None:
    """Restore the registry after the test."""
    hands = {each.id for each in registry.runtime_entries()}
    monkeypatch.setattr(registry, "_entries", registry.entries())
    monkeypatch.setattr(registry, "_runtime_ids", hands)


def shorten(monkeypatch, *ids: str) -> None:
    """Give registered ids their short worlds, in other processes too."""
    register_apart(monkeypatch)
    registry.import_entries([replace(entry(id), world=entry(id).world.with_changes(world(id)["world"])) for id in ids])
