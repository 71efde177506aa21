"""Worlds with some numbers changed: what is the same, and what is refused."""

import dataclasses
import pickle

import pytest
from eitbench.worlds import entries
from eitbench.worlds.catalogue import PIPE_2D


def test_only_what_is_named_changes():
    """Everything else is the same object; lists become tuples, and a part's part can be changed."""
    world = PIPE_2D.changed({"target": {"strength": [0.1, 0.2], "arrivals": {"interval": 0.03}},
                             "instrument": {"noise_relative": 0.02}})
    assert world.target.strength == (0.1, 0.2)
    assert world.target.arrivals.interval == 0.03
    assert world.target.duration == PIPE_2D.target.duration
    assert world.instrument.noise_relative == 0.02
    assert world.vessel is PIPE_2D.vessel
    assert world.schedule is PIPE_2D.schedule
    assert world.name == PIPE_2D.name
    assert PIPE_2D.target.strength == (0.22, 0.40)
    assert PIPE_2D.changed(None) is PIPE_2D
    assert PIPE_2D.changed({}) == PIPE_2D
    back = world.changed({"target": {"strength": [0.22, 0.40], "arrivals": {"interval": 0.02}},
                          "instrument": {"noise_relative": 0.01}})
    assert back == PIPE_2D
    assert hash(back) == hash(PIPE_2D)


@pytest.mark.parametrize("id", entries())
def test_every_number_can_be_named(id):
    """A change of each to what it is changes nothing; and a copy from another process is equal."""
    world = entries()[id].world

    def numbers(part) -> dict:
        found = {}
        for each in dataclasses.fields(part):
            value = getattr(part, each.name)
            found[each.name] = numbers(value) if dataclasses.is_dataclass(value) else value
        return found

    changes = numbers(world)
    del changes["name"]
    again = world.changed(changes)
    assert again == world
    assert hash(again) == hash(world)
    assert pickle.loads(pickle.dumps(world)) == world


@pytest.mark.parametrize(("changes", "message"), [
    ({"colour": 1}, "^world has no 'colour'; there are vessel, flow, target, instrument, "
                    "schedule, prior, region$"),
    ({"name": "Mine"}, "^world must not change its name"),
    ([1], r"^world must be a dict of parts and their numbers, got \[1\]"),
    ({"vessel": {"radius": 1.0}}, "^world.vessel has no 'radius'; there are length, half_width"),
    ({"vessel": {"length": "far"}}, "^world.vessel: length must be a number in m, got 'far'"),
    ({"vessel": {"electrodes_per_wall": 2.5}}, "^world.vessel: electrodes_per_wall must be an int"),
    ({"flow": {"mean_velocity": 0.0}}, "^world.flow: mean_velocity must be a finite number"),
    ({"target": {"width": [0.02, 0.01]}}, "^world.target: width must be a range"),
    ({"target": {"arrivals": {"interval": 0.0}}}, "^world.target.arrivals: interval must be"),
    ({"instrument": {"untold_noise": -1.0}}, "^world.instrument: untold_noise must be a finite number in"),
    ({"target": {"reach": [0.5, 1.1]}}, "^world.target: reach must end above 0 and at most at 1"),
    ({"instrument": {"dead": [8, 8], "failing": [7, 7]}}, "must leave two electrodes sound"),
    ({"schedule": {"time_step": float("nan")}}, "^world.schedule: time_step must be"),
    ({"region": [0.0, 0.5]}, "region must be a range 0 ≤ begin < end ≤ 0.4 m"),
])
def test_what_is_wrong_is_named(changes, message):
    """By the place of the part, the name of the number, what came and what is allowed."""
    with pytest.raises(ValueError, match=message):
        PIPE_2D.changed(changes)
