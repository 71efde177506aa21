"""Renamed classes and fields keep their stored keys; third-party classes may have earlier names of members."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from eitbench.data.cache import config_dict, episode_key, world_digest
from eitbench.data.episode_cache import prefix_file, scoring_constants_file
from eitbench.worlds import Target, entries, entry
from eitbench.worlds.catalogue import PIPE_2D
from eitbench.worlds.slugs import Slugs
from eitbench.worlds.stored_names import MEMBERS, add_current_members
from eitbench.worlds.vessels import MeshVessel

KEYS = json.loads(Path(__file__).with_name("stored_keys.json").read_text())
"""Built-in id -> world digest, folder of its episodes, names of its package data."""


@pytest.mark.parametrize("id", KEYS | {id: None for id in entries() if id.startswith("eitbench/")})
def test_keys_do_not_change(id):
    """Keys of records, cached episodes and package data are as before the classes were renamed. A new id needs an entry
    in the file."""
    world = entry(id).world
    assert KEYS[id] == [world_digest(world)[:16], episode_key(world, "0").folder,
                        scoring_constants_file(world).key.name, prefix_file(world).key.name]


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


@dataclass(frozen=True)
class Earlier(Target):
    """A third-party target with the earlier names of members."""

    background: float = 30.0
    evolve = None
    is_carried = False
    stands_still = True


def test_third_party_parts_may_have_earlier_names_of_members():
    """A world finds them, also if they replace a default; each member has a present name."""
    world = replace(PIPE_2D, target=Earlier())
    assert world.target.is_stationary and not world.target.is_advected
    members = {old: object() for old in MEMBERS.values()}
    part = type("Mine", (), members)
    add_current_members(part)
    assert all(getattr(part(), new) is members[old] for new, old in MEMBERS.items())
