"""A short world for every id: what is promised does not depend on the length of a record."""

from dataclasses import replace

from eitbench.worlds import entries, entry, registry

PLAIN = [name for name, each in entries().items() if each.world == entry("eitbench/Pipe2D-v0").world]
"""Ids that play the thesis' pipe as it is."""


def merged(*changes: dict) -> dict:
    """Changes of a world put together, part by part."""
    result: dict = {}
    for each in changes:
        for name, value in each.items():
            both = isinstance(value, dict) and isinstance(result.get(name), dict)
            result[name] = merged(result[name], value) if both else value
    return result


FAST = {"flow": {"mean_velocity": 45.0}, "schedule": {"scored_steps": 5, "pattern": {"frame": 2}}}
"""A fast fluid flushes a pipe in two steps: seven measurements, of which five are scored."""
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
"""Changes that make a world's episodes short, by its name; electrodes that fail leave some of four sound."""


def world(name: str) -> dict:
    """Keyword arguments that make an id's episodes short."""
    each = entry(name).world
    kind = "Pipe2DInjectionFaults" if each.instrument.max_faulty else each.name
    assert kind in SHORT, f"{name} has no short version yet: give {kind!r} one in tests/short.py"
    return {"world": SHORT[kind]}


def short(name: str) -> dict:
    """And its training episodes few."""
    return world(name) | {"episodes": 2}


def register_apart(monkeypatch) -> None:
    """What is registered from now on is forgotten after the test."""
    hands = {each.id for each in registry.runtime_entries()}
    monkeypatch.setattr(registry, "_entries", registry.entries())
    monkeypatch.setattr(registry, "_runtime_ids", hands)


def shorten(monkeypatch, changes: dict[str, dict]) -> None:
    """Let registered ids play other worlds, in other processes too: id -> changes of the world."""
    register_apart(monkeypatch)
    registry.import_entries([replace(entry(name), world=entry(name).world.with_changes(each))
                             for name, each in changes.items()])
