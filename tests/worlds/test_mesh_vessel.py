"""A vessel from mesh files: the same physics as a built-in vessel, and errors for missing groups."""

import hashlib
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
from eitbench.bench.isolation import Worker
from eitbench.numerics.round_meshes import electrode_disc
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.worlds import World, register
from eitbench.worlds.bodies import Cylinders
from eitbench.worlds.flows import NoFlow
from eitbench.worlds.schedule import Schedule, TankOppositeDiagonalPattern
from eitbench.worlds.vessels import MeshVessel, RoundTank

from shapes import write_mesh
from short import register_apart
from tiny import ISOLATION, write_baseline

TANK = RoundTank(n_electrodes=8)


class RoundMeshVessel(MeshVessel):
    """A mesh vessel with a radius, which the cylinders require."""

    radius = TANK.radius


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Return paths, hashes and meshes of a fine and a coarse discretisation of the round tank."""
    folder = tmp_path_factory.mktemp("meshes")
    made = {}
    for name, size in (("fine", (4, 10)), ("coarse", (2, 6))):
        mesh = electrode_disc(TANK.radius, TANK.electrode_spans, *size)
        groups = {f"electrode {l}": facets for l, facets in enumerate(TANK.electrodes(mesh))}
        path = folder / f"{name}.msh"
        write_mesh(path, mesh, groups)
        made[name] = str(path), hashlib.sha256(path.read_bytes()).hexdigest(), mesh
    return made


@pytest.fixture
def vessel(files):
    (fine, fine_hash, _), (coarse, coarse_hash, _) = files["fine"], files["coarse"]
    return RoundMeshVessel(fine, fine_hash.upper(), coarse, coarse_hash, 8)


def test_electrodes_are_those_of_the_groups(files, vessel):
    """The transfer resistance is bit-identical to a model of the same mesh in memory."""
    for fine, name in ((True, "fine"), (False, "coarse")):
        mesh = files[name][2]
        direct = CompleteElectrodeModel(mesh, TANK.electrodes(mesh), vessel.contact_impedance)
        sigma = 0.3 + 0.1 * np.sin(40.0 * mesh.points[:, 0])
        np.testing.assert_array_equal(vessel.electrode_model(fine).transfer_resistance(sigma),
                                      direct.transfer_resistance(sigma))
        np.testing.assert_array_equal(vessel.transport_mesh(fine)[0].points, mesh.points)


@pytest.mark.parametrize("name", ["electrode_{}", "Electrode {}", "electrode-{}", "electrode{}"])
def test_electrodes_may_count_from_one(name, files, vessel, tmp_path):
    mesh = files["coarse"][2]
    path = tmp_path / "named.msh"
    write_mesh(path, mesh, {name.format(l + 1): facets for l, facets in enumerate(TANK.electrodes(mesh))})
    sigma = np.full(mesh.n_nodes, 0.3)
    named = RoundMeshVessel(*[str(path), hashlib.sha256(path.read_bytes()).hexdigest()] * 2, 8)
    np.testing.assert_array_equal(named.electrode_model(False).transfer_resistance(sigma),
                                  vessel.electrode_model(False).transfer_resistance(sigma))


def test_a_world_with_it_runs(files, vessel, monkeypatch, tmp_path):
    """A script can register it with relative paths, and it runs like other ids, also isolated methods; no inflow."""
    register_apart(monkeypatch)
    monkeypatch.chdir(Path(files["fine"][0]).parent)
    vessel = replace(vessel, truth_mesh_file="fine.msh", model_mesh_file="coarse.msh")
    world = World("Meshed", vessel, NoFlow(), Cylinders(), schedule=Schedule(
        time_step=0.02, scored_steps=4, pattern=TankOppositeDiagonalPattern(), warm_up=0, calibration=1))
    register(world, "test/Meshed-v0")
    env = gym.make("test/Meshed-v0")
    observation, _ = env.reset(seed=1)
    assert observation["voltages"].shape == (8,) and len(vessel.transport_mesh(False)[1]) == 0
    level = np.full(env.action_space.shape, 30.0)
    rewards = [env.step(level)[1] for _ in range(4)]
    assert all(-5.0 < reward < 0.0 for reward in rewards)
    cloudpickle.register_pickle_by_value(sys.modules[__name__])
    with closing(Worker("estimation", "test/Meshed-v0", {}, write_baseline(tmp_path), ISOLATION)) as worker:
        assert worker(None).update(np.zeros(8), np.zeros(8)).mean.shape == level.shape
    gym.registry.pop("test/Meshed-v0")


def test_another_file_is_refused(files, vessel):
    """The world identifies the file by its hash; a missing group is named."""
    changed = RoundMeshVessel(files["fine"][0], "0" * 64, *files["coarse"][:2], 8)
    with pytest.raises(ValueError, match=rf"fine\.msh: must be the file with SHA-256 0000.*, got .*{files['fine'][1]}"):
        changed.transport_mesh(True)
    few = RoundMeshVessel(*files["fine"][:2], *files["coarse"][:2], 7)
    with pytest.raises(ValueError, match=r"n_electrodes must be 8, the number of groups in .*, got 7"):
        few.electrode_model(False)
    many = RoundMeshVessel(*files["fine"][:2], *files["coarse"][:2], 9)
    with pytest.raises(ValueError, match="must have a group for each electrode, got none for electrode 8"):
        many.electrode_model(False)
