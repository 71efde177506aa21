"""Worlds with some numbers changed: what is refused, and which of them share their episodes."""

import dataclasses
import pickle

import numpy as np
import pytest
from eitbench.data import cache
from eitbench.worlds import entries
from eitbench.worlds.catalogue import PIPE_2D, PIPE_2D_CURRENTS, PIPE_2D_DRIFTING, PIPE_2D_FAULTS, STATIONARY_TANK_2D


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


def test_parts_can_be_swapped():
    """For another dataclass, not for a number."""
    faulty = PIPE_2D.changed({"instrument": PIPE_2D_FAULTS.instrument})
    assert faulty == PIPE_2D_FAULTS
    with pytest.raises(ValueError, match=r"world.instrument must be a dict of its numbers, got 3"):
        PIPE_2D.changed({"instrument": 3})


@pytest.mark.parametrize(("changes", "message"), [
    ({"colour": 1}, "^world has no 'colour'; there are vessel, flow, target, instrument, "
                    "schedule, prior, region$"),
    ({"name": "Mine"}, "^world must not change its name"),
    ([1], r"^world must be a dict of parts and their numbers, got \[1\]"),
    ({"vessel": {"radius": 1.0}}, "^world.vessel has no 'radius'; there are length, half_width"),
    ({"schedule": {"frame": 3}}, "^world.schedule has no 'frame'; there are time_step"),
    ({"vessel": {"length": -1.0}}, r"^world.vessel: length must be a finite number in \(0, inf\]"),
    ({"vessel": {"length": "far"}}, "^world.vessel: length must be a number in m, got 'far'"),
    ({"vessel": {"electrodes_per_wall": 2.5}}, "^world.vessel: electrodes_per_wall must be an int"),
    ({"flow": {"mean_velocity": 0.0}}, "^world.flow: mean_velocity must be a finite number"),
    ({"flow": {"mean_velocity": None}}, "^world.flow: mean_velocity must be a number in m/s"),
    ({"flow": {"mean_velocity": 10**400}}, "^world.flow: mean_velocity must be a number in m/s"),
    ({"flow": {"mean_velocity": b"4"}}, "^world.flow: mean_velocity must be a number in m/s"),
    ({"flow": {"mean_velocity": np.complex128(4.0)}}, "^world.flow: mean_velocity must be a number in m/s"),
    ({"target": {"width": [0.02, 0.01]}}, "^world.target: width must be a range"),
    ({"target": {"arrivals": {"interval": 0.0}}}, "^world.target.arrivals: interval must be"),
    ({"instrument": {"noise_relative": -0.1}}, "^world.instrument: noise_relative must be"),
    ({"instrument": {"untold_noise": -1.0}}, "^world.instrument: untold_noise must be a finite number in"),
    ({"instrument": {"contact_spread": 1.0}}, "^world.instrument: contact_spread must be a finite number in"),
    ({"target": {"reach": [0.5, 1.1]}}, "^world.target: reach must end above 0 and at most at 1"),
    ({"target": {"reach": [0.0, 0.0]}}, "^world.target: reach must end above 0"),
    ({"instrument": {"dead": [8, 8], "failing": [7, 7]}}, "must leave two electrodes sound"),
    ({"schedule": {"scored_steps": 0}}, "^world.schedule: scored_steps must be an integer"),
    ({"schedule": {"pattern": {"frame": 0}}}, "^world.schedule.pattern: frame must be"),
    ({"schedule": {"time_step": float("nan")}}, "^world.schedule: time_step must be"),
    ({"prior": {"expected_concentration": 0.0}}, "^world.prior: expected_concentration must be"),
    ({"region": [0.0, 0.5]}, "region must be a range 0 ≤ begin < end ≤ 0.4 m"),
    ({"region": "end"}, "region must be an array of numbers in m"),
])
def test_what_is_wrong_is_named(changes, message):
    """By the place of the part, the name of the number, what came and what is allowed."""
    with pytest.raises(ValueError, match=message):
        PIPE_2D.changed(changes)


@pytest.mark.parametrize("changes", [
    {"instrument": {"noise_relative": 0.02}},
    {"instrument": {"noise_of_largest": 0.0}},
    {"instrument": {"noise_floor": 1e-3}},
    {"instrument": {"limit": "L1"}},
    {"instrument": {"untold_noise": 2.0}},
    {"instrument": {"dead": [1, 2], "failing": [0, 1], "loose": [0, 3], "interference": 1.0}},
    {"schedule": {"budget": 7}},
    {"prior": {"nodal_std": 0.1, "inflow_std": 0.5, "initial_std": 0.1, "initial_length": 0.02}},
])
def test_instruments_and_beliefs_share_episodes(changes):
    """What is read and believed moves no fluid, and neither does a budget."""
    assert cache.folder(PIPE_2D.changed(changes)) == cache.folder(PIPE_2D)


def test_ids_of_one_pipe_share_episodes():
    """The plain pipe, the one whose wires break, and the one with a source for each electrode."""
    assert len({cache.folder(world) for world in (PIPE_2D, PIPE_2D_FAULTS, PIPE_2D_CURRENTS)}) == 1


@pytest.mark.parametrize("changes", [
    {"vessel": {"length": 0.5}},
    {"vessel": {"contact_impedance": 1e-3}},
    {"instrument": {"contact_spread": 0.5}},
    {"target": {"reach": [0.0, 0.5]}},
    {"flow": {"mean_velocity": 4.0}},
    {"flow": {"diffusivity": 1e-3}},
    {"target": {"background": 31.0}},
    {"target": {"arrivals": {"interval": 0.03}}},
    {"schedule": {"scored_steps": 81}},
    {"schedule": {"time_step": 4e-3}},
    {"schedule": {"warm_up": 20}},
    {"schedule": {"pattern": {"frame": 15}}},
])
def test_other_fluids_do_not_share_episodes(changes):
    """Whatever the truth depends on keeps its episodes apart."""
    assert cache.folder(PIPE_2D.changed(changes)) != cache.folder(PIPE_2D)


def test_regions_have_integrals_of_their_own():
    """And so a folder of their own."""
    whole = PIPE_2D_DRIFTING.changed({"region": None})
    assert cache.folder(whole) != cache.folder(PIPE_2D_DRIFTING)


def test_noise_is_that_of_the_instrument():
    """Read and believed."""
    world = STATIONARY_TANK_2D.changed({"instrument": {"noise_relative": 0.05,
                                                       "noise_floor": 1e-3}})
    assert (world.noise.relative, world.noise.floor) == (0.05, 0.0)
    assert world.instrument.believed_noise.floor == 1e-3
    assert world.sound.instrument.noise_floor == 0.0
    assert world.sound.instrument.noise_relative == 0.05
