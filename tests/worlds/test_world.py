"""A world: overrides of parameters, protocols of its components, and random streams from a state."""

import dataclasses
import json
import pickle

import numpy as np
import pytest
from eitbench.worlds import entries
from eitbench.worlds.catalogue import (
    BUBBLE_TRACKING,
    PIPE_2D,
    PIPE_2D_TURBULENT,
    PIPE_3D,
    ROTATING_TANK_2D,
    STATIONARY_TANK_2D,
    TANK_TRACKING,
)
from eitbench.worlds.catalogue import PIPE_2D_TIME_VARYING as DRAWN
from eitbench.worlds.flows import NoFlow
from eitbench.worlds.random_streams import episode_streams, generator_from_state
from eitbench.worlds.vessels import Bulge, PlanePipe

SMALL_3D = dataclasses.replace(PIPE_3D.vessel, electrode_rings=1, electrodes_per_ring=6)


def test_only_what_is_named_changes():
    """Other components are the same objects; lists become tuples, and nested components can be changed."""
    world = PIPE_2D.with_changes({"target": {"log_amplitude": [0.1, 0.2], "arrivals": {"interval": 0.03}},
                             "instrument": {"noise_relative": 0.02}})
    assert world.target.log_amplitude == (0.1, 0.2)
    assert world.target.arrivals.interval == 0.03
    assert world.target.time_std == PIPE_2D.target.time_std
    assert world.instrument.noise_relative == 0.02
    assert world.vessel is PIPE_2D.vessel
    assert world.schedule is PIPE_2D.schedule
    assert PIPE_2D.with_changes(None) is PIPE_2D
    back = world.with_changes({"target": {"log_amplitude": [0.22, 0.40], "arrivals": {"interval": 0.02}},
                          "instrument": {"noise_relative": 0.01}})
    assert back == PIPE_2D
    assert hash(back) == hash(PIPE_2D)


@pytest.mark.parametrize("id", entries())
def test_every_number_can_be_named(id):
    """Overrides with present values change nothing; a copy from another process is equal."""
    world = entries()[id].world
    changes = dataclasses.asdict(world)
    del changes["name"]
    again = world.with_changes(changes)
    assert again == world
    assert hash(again) == hash(world)
    assert pickle.loads(pickle.dumps(world)) == world


@pytest.mark.parametrize(("world", "changes", "message"), [
    (PIPE_2D, {"colour": 1}, "^world has no 'colour'; there are vessel, flow, target, instrument, "
                             "schedule, prior, region$"),
    (PIPE_2D, {"name": "Mine"}, "^world must not change its name"),
    (PIPE_2D, [1], r"^world must be a dict of parts and their numbers, got \[1\]"),
    (PIPE_2D, {"vessel": {"radius": 1.0}}, "^world.vessel has no 'radius'; there are length, half_width"),
    (PIPE_2D, {"vessel": {"length": "far"}}, "^world.vessel: length must be a number in m, got 'far'"),
    (PIPE_2D, {"target": {"arrivals": {"interval": 0.0}}}, "^world.target.arrivals: interval must be"),
    (PIPE_2D, {"target": {"radial_range": [0.5, 1.1]}}, "^world.target: radial_range must end above 0"),
    (PIPE_2D, {"instrument": {"n_dead_range": [8, 8], "n_failing_range": [7, 7]}}, "electrodes without fault"),
    (PIPE_2D, {"schedule": {"time_step": float("nan")}}, "^world.schedule: time_step must be"),
    (PIPE_2D, {"region": [0.0, 0.5]}, "region must be a range 0 ≤ begin < end ≤ 0.4 m"),
    (DRAWN, {"flow": {"velocity_range": (5.0, 4.0)}}, "^world.flow: velocity_range must be a range low ≤ high"),
    (DRAWN, {"flow": {"oscillation_range": (0.5, 1.0)}}, "^world.flow: oscillation_range must lie below 1"),
    (DRAWN, {"flow": {"skewness_range": (0.6, 5.5)}}, "skewness_range below 5"),
    (PIPE_3D, {"vessel": {"electrode_length": 0.2}}, "^world.vessel: electrode_length must leave gaps"),
    (ROTATING_TANK_2D, {"vessel": {"electrode_coverage": 1.0}}, "electrode_coverage"),
    (ROTATING_TANK_2D, {"flow": {"stirrer_position": (np.nan, 0.0)}}, "stirrer_position must be"),
    (ROTATING_TANK_2D, {"target": {"initial_radius_range": (0.5, 0.9)}}, "range .* keeps the disc"),
    (STATIONARY_TANK_2D, {"vessel": {"n_electrodes": 7}}, "n_electrodes must be an integer of at least 8"),
    (STATIONARY_TANK_2D, {"target": {"min_gap": 0.12}}, "min_gap must leave room"),
    (STATIONARY_TANK_2D, {"target": {"max_centre_radius": 0.8}}, "max_centre_radius must be"),
    (STATIONARY_TANK_2D, {"target": {"small_radius": (0.018, 0.035)}}, "small_radius must not reach beyond large"),
    (TANK_TRACKING, {"target": {"radius_range": (0.01, 0.2)}}, "radius_range must end below half of the radius"),
    (TANK_TRACKING, {"instrument": {"readings": "some"}}, "readings must be one of all, neighbours, chosen"),
    (TANK_TRACKING, {"instrument": {"readings": "chosen", "n_voltmeters": 17}},
     "n_voltmeters must be an integer of at least 1 and at most 16, got 17"),
    (TANK_TRACKING, {"instrument": {"readings": "chosen", "current_norm": "L1"}},
     "current_norm must be None with the readings 'chosen', got 'L1'"),
    (BUBBLE_TRACKING, {"target": {"radius_range": (0.01, 0.045)}}, "radius_range and amplitude_range must have a sum"),
    (BUBBLE_TRACKING, {"vessel": PlanePipe(bulge=Bulge())}, "target must be in a PlanePipe without a bulge"),
    (BUBBLE_TRACKING, {"flow": NoFlow()}, "flow must be a flow through the pipe"),
    (BUBBLE_TRACKING, {"target": {"n_bodies": 5}}, "n_bodies must be an integer of at least 1 and at most 4, got 5"),
    (PIPE_2D_TURBULENT, {"flow": {"profile": "plug"}}, "profile"),
], ids=str)
def test_what_is_wrong_is_named(world, changes, message):
    """The message contains the part, the field, the value and the allowed range."""
    with pytest.raises(ValueError, match=message):
        world.with_changes(changes)


@pytest.mark.parametrize(("name", "part", "message"), [
    ("vessel", PIPE_2D.flow, "vessel must be a Vessel, with .*; got LaminarFlow without .*electrode_model"),
    ("flow", None, "flow must be a Flow, with .*; got NoneType without .*nominal"),
    ("target", PIPE_2D.vessel, "target must be a Target, with .*; got PlanePipe without .*evolve")])
def test_a_part_without_what_its_protocol_asks_for_is_refused(name, part, message):
    """The message names the part, what came and what is missing."""
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(PIPE_2D, **{name: part})


@pytest.mark.parametrize(("vessel", "nodes", "unknowns", "substeps"), [
    (PIPE_2D.vessel, 6, 2, 4), (SMALL_3D, 4, 1.8, 2), (STATIONARY_TANK_2D.vessel, 3, 2, 1)])
def test_truth_is_finer_than_the_model(vessel, nodes, unknowns, substeps):
    """No inverse crime: more transport nodes, unknowns and sub-steps; voltages differ by 1e-6 … 1 %."""
    meshes = [vessel.transport_mesh(fine)[0] for fine in (True, False)]
    models = [vessel.electrode_model(fine) for fine in (True, False)]
    assert meshes[0].n_nodes > nodes * meshes[1].n_nodes
    assert models[0].n_unknowns > unknowns * models[1].n_unknowns
    assert vessel.n_truth_steps * vessel.substeps(True) >= substeps * vessel.substeps(False)
    if meshes[0].dim == 2:
        fine, coarse = (model.transfer_resistance(np.full(len(model.mesh.points), 0.3)) for model in models)
        assert 1e-6 < np.abs(fine - coarse).max() / np.abs(fine).max() < 1e-2


def test_a_generator_goes_on_from_a_state():
    """A generator from a state continues the stream, also through JSON; spawned streams differ by episode."""
    spawned = []
    for seed in range(3):
        policy = episode_streams(seed).policy
        state = policy.bit_generator.state
        for given in (state, json.loads(json.dumps(state))):
            copy = generator_from_state(given)
            assert copy.bit_generator.state == state
            spawned.append(copy.spawn(1)[0].integers(2**63))
        np.testing.assert_array_equal(copy.standard_normal(5), policy.standard_normal(5))
    assert spawned[::2] == spawned[1::2] and len(set(spawned)) == 3
