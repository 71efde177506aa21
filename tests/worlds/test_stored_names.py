"""Renamed classes and fields keep their stored keys; earlier names in scripts and records still work."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from eitbench.data.cache import config_dict, episode_key, world_digest
from eitbench.data.episode_cache import prefix_file, scoring_constants_file
from eitbench.worlds import Target, TruthTrajectory, entries, entry, register, registry
from eitbench.worlds.catalogue import PIPE_2D, PIPE_2D_FAULTS, ROTATING_TANK_2D
from eitbench.worlds.flows import PipeFlow
from eitbench.worlds.schedule import OppositeDiagonalPattern
from eitbench.worlds.slugs import JitteredArrivals, Slugs
from eitbench.worlds.stored_names import STORED_NAMES
from eitbench.worlds.vessels import MeshVessel, RoundTank
from eitbench.worlds.world import World

from short import register_apart

KEYS = json.loads(Path(__file__).with_name("stored_keys.json").read_text())
"""Built-in id -> world digest, folder of its episodes, names of its package data."""


@pytest.mark.parametrize("id", KEYS)
def test_keys_do_not_change(id):
    """Keys of records, cached episodes and package data are as before the classes were renamed."""
    world = entry(id).world
    assert KEYS[id] == [world_digest(world)[:16], episode_key(world, "0").folder,
                        scoring_constants_file(world).key.name, prefix_file(world).key.name]


def test_all_built_in_ids_have_keys():
    """A new id needs an entry in the file."""
    assert list(KEYS) == [id for id in entries() if id.startswith("eitbench/")]


def test_mesh_vessels_keep_their_names():
    """No built-in id uses this class."""
    vessel = MeshVessel("a.msh", "0", "b.msh", "1", 16)
    assert config_dict(vessel) == {
        "kind": "MeshVessel", "fine_file": "a.msh", "fine_sha256": "0", "coarse_file": "b.msh", "coarse_sha256": "1",
        "n_electrodes": 16, "scale": 1.0, "contact_impedance": 2e-3, "molar_conductivity": 0.01, "patches": [6, 6],
        "is_long": False}


def test_third_party_fields_keep_their_names():
    """A field of a third-party class may have the name of a renamed built-in field."""
    @dataclass(frozen=True)
    class Mine(Slugs):
        dead_time: float = 1.0

    names = config_dict(Mine()).keys()
    assert {"dead_time", "strength"} < names and not {"interval", "log_amplitude"} & names


def test_the_map_names_existing_fields():
    """Each new name is the name of a class or field."""
    def names(part) -> set[str]:
        own = {type(part).__name__} | {each.name for each in fields(part)}
        return own.union(*(names(value) for value in vars(part).values() if is_dataclass(value)))

    worlds = set().union(*(names(each.world) for each in entries().values()))
    assert set(STORED_NAMES) <= worlds | {each.name for each in fields(MeshVessel)}


@pytest.mark.parametrize(("world", "old", "new"), [
    (PIPE_2D, {"target": {"strength": [0.1, 0.2], "width": [0.01, 0.02]}},
     {"target": {"log_amplitude": [0.1, 0.2], "transverse_std": [0.01, 0.02]}}),
    (PIPE_2D, {"instrument": {"untold_noise": 2.0, "limit": "L1"}, "vessel": {"electrode_cover": 0.4}},
     {"instrument": {"noise_mismatch": 2.0, "current_norm": "L1"}, "vessel": {"electrode_coverage": 0.4}}),
    (PIPE_2D_FAULTS, {"instrument": {"dead": [1, 1]}}, {"instrument": {"n_dead_range": [1, 1]}}),
    (ROTATING_TANK_2D, {"target": {"start_radius": [0.3, 0.4]}}, {"target": {"initial_radius_range": [0.3, 0.4]}})])
def test_earlier_names_of_fields_are_accepted(world, old, new):
    """The warning contains the new name."""
    with pytest.warns(DeprecationWarning, match=r"\w+ is now \w+"):
        changed = world.with_changes(old)
    assert changed == world.with_changes(new)


def test_a_field_may_have_the_earlier_name_of_another():
    """`interval` is a field of one class of arrivals and the earlier name of `dead_time` in another."""
    world = PIPE_2D.with_changes({"target": {"arrivals": {"interval": 0.03}}})
    assert world.target.arrivals == JitteredArrivals(0.03)


def test_earlier_members_of_a_world():
    """Third-party components may use earlier names."""
    with pytest.warns(DeprecationWarning, match="lead_in is now spin_up_steps"):
        assert PIPE_2D.lead_in == PIPE_2D.spin_up_steps
    with pytest.warns(DeprecationWarning, match="changed is now with_changes"):
        assert PIPE_2D.changed(None) is PIPE_2D
    with pytest.raises(AttributeError, match="World has no attribute 'nothing'"):
        _ = PIPE_2D.nothing


@dataclass(frozen=True)
class EarlierTank:
    """A third-party vessel with the earlier names of members."""

    tank: RoundTank = field(default_factory=RoundTank)
    patches: tuple[int, int] = (2, 2)
    n_electrodes = 16
    contact_impedance = 2e-3
    molar_conductivity = 0.01
    is_long = False
    parts_of_a_step = 1

    @property
    def electrodes_per_wall(self):
        return 8

    def carrier(self, fine):
        return self.tank.transport_mesh(fine)

    def substeps(self, fine):
        return 4

    def electrode_model(self, fine):
        return self.tank.electrode_model(fine)


@dataclass(frozen=True)
class EarlierFlow(PipeFlow):
    """Overrides a default under its earlier name."""

    def nominal(self, world, fine):
        return lambda points: np.zeros_like(points)

    def believed(self, world, **assumed):
        return lambda points: np.ones_like(points)

    def flush_steps(self, world):
        return 7


@dataclass(frozen=True)
class EarlierTarget(Target):
    background: float = 30.0
    is_carried = False
    stands_still = True

    def evolve(self, world, episodes: Sequence, truth, tick, last) -> Iterator[TruthTrajectory]:
        for _ in episodes:
            yield TruthTrajectory(np.full((last + 1, truth.transport.mesh.n_nodes), 30.0), np.empty((last, 0)))


def test_third_party_parts_with_earlier_members():
    """A vessel, a flow and a target with earlier names of members make a world."""
    world = World("Mine", EarlierTank(), EarlierFlow(), EarlierTarget(),
                  schedule=replace(PIPE_2D.schedule, pattern=OppositeDiagonalPattern()))
    assert world.vessel.coarse_grid_shape == (2, 2) and not world.vessel.is_elongated
    assert world.residence_steps == world.spin_up_steps == 7
    assert world.target.is_stationary and not world.target.is_advected
    model = world.estimator_model()
    assert (model.transport.velocity(np.zeros((1, 2))) == 1.0).all()
    assert world.truth_model().transport.mesh.n_nodes == world.vessel.transport_mesh(fine=True)[0].n_nodes


def test_earlier_keywords_of_register(monkeypatch):
    """`about`, `seeds` and `home` are accepted."""
    register_apart(monkeypatch)
    with pytest.warns(DeprecationWarning, match="is now"):
        register(PIPE_2D, "mine/Copy-v0", about="A copy.", seeds="test:0-1", home="eitbench/Pipe2D-v0")
    each = registry.entry("mine/Copy-v0")
    assert (each.description, each.test_seeds, each.nominal) == ("A copy.", "test:0-1", "eitbench/Pipe2D-v0")
