"""A short world for each id: guarantees do not depend on the length of an episode."""

from dataclasses import replace

from eitbench.worlds import entries, entry, registry

PLAIN = [name for name, each in entries().items() if each.world == entry("eitbench/Pipe2D-v0").world]
"""Ids with the thesis' pipe as it is."""


def merged(*changes: dict) -> dict:
    """Merge overrides of a world by component."""
    result: dict = {}
    for each in changes:
        for name, value in each.items():
            both = isinstance(value, dict) and isinstance(result.get(name), dict)
            result[name] = merged(result[name], value) if both else value
    return result


FAST = {"flow": {"mean_velocity": 45.0}, "schedule": {"scored_steps": 5, "pattern": {"frame": 2}}}
"""With a fast flow the residence time is two steps: seven measurements, five of them scored."""
PIPE = merged(FAST, {"vessel": {"electrodes_per_wall": 2}})
FLOW = merged(PIPE, {"flow": {"velocity_range": [40.0, 50.0]}})
WANDERING = merged(FLOW, {"region": [0.28, 0.40]})
TANK = {"vessel": {"n_electrodes": 8}, "schedule": {"warm_up": 1, "scored_steps": 4}}

SHORT = {
    "Pipe2D": PIPE,
    "Pipe2DInjectionFaults": merged(PIPE, {"instrument": {
        "n_dead_range": [0, 1], "n_failing_range": [0, 1], "n_loose_range": [0, 0]}}),
    "Pipe2DIntermittent": merged(PIPE, {"target": {"arrivals": {"dead_time": 0.01, "mean_wait": 0.001}}}),
    "Pipe2DDriftingVelocity": WANDERING,
    "Pipe2DBiasedVelocity": FLOW,
    "Pipe2DUnknownVelocity": FLOW,
    "Pipe2DTimeVaryingVelocity": FLOW,
    "Pipe2DSkewedVelocity": FLOW,
    "Pipe2DObstacle": merged(PIPE, {"flow": {"viscosity": 0.04}, "vessel": {"bulge": {"height": 0.01}}}),
    "Pipe2DShortSlugs": PIPE,
    "Pipe2DStrongSlugs": PIPE,
    "Pipe2DOtherVelocity": FLOW,
    "Pipe2DOtherContacts": PIPE,
    "Pipe2DOtherInlet": PIPE,
    "Pipe3D": {"flow": {"mean_velocity": 45.0}, "schedule": {"scored_steps": 3, "pattern": {"frame": 2}},
               "vessel": {"potential_order": 1, "electrode_rings": 1, "electrodes_per_ring": 4}},
    "RotatingTank2D": TANK,
    "StationaryTank2D": {"vessel": {"n_electrodes": 8}, "schedule": {"scored_steps": 5}},
}
"""Name of a world -> overrides for short episodes; some of four electrodes stay intact."""


def world(name: str) -> dict:
    """Return keyword arguments for short episodes of an id."""
    each = entry(name).world
    kind = "Pipe2DInjectionFaults" if each.instrument.max_faulty else each.name
    assert kind in SHORT, f"{name} has no short version yet: give {kind!r} one in tests/short.py"
    return {"world": SHORT[kind]}


def short(name: str) -> dict:
    """Return keyword arguments for short episodes and few training episodes."""
    return world(name) | {"episodes": 2}


def register_apart(monkeypatch) -> None:
    """Restore the registry after the test."""
    hands = {each.id for each in registry.runtime_entries()}
    monkeypatch.setattr(registry, "_entries", registry.entries())
    monkeypatch.setattr(registry, "_runtime_ids", hands)


def shorten(monkeypatch, changes: dict[str, dict]) -> None:
    """Override worlds of registered ids (id -> overrides), in other processes too."""
    register_apart(monkeypatch)
    registry.import_entries([replace(entry(name), world=entry(name).world.with_changes(each))
                             for name, each in changes.items()])
