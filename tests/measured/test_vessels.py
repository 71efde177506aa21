"""Descriptions of vessels: shapes, orders of electrodes, flows, and meshes of KTC's format."""

import numpy as np
import pytest
from eitbench.bench.playing import run_on_measurements
from eitbench.envs.measured import MeasuredEnv
from eitbench.measured.vessel import read_vessel
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.worlds.vessels import RoundTank
from scipy.io import savemat
from tanks import BELIEVED, VESSEL, angle, centroid, moving

PIPE = {"kind": "rectangle", "length": 0.4, "width": 0.1, "electrodes": 16, "cover": 0.5}
CYLINDER = {"kind": "cylinder", "length": 0.2, "radius": 0.05, "rings": 2, "electrodes": 4, "height": 0.04,
            "cover": 0.5}
TANK = RoundTank(radius=0.1, n_electrodes=8, electrode_cover=0.4)


def test_a_yaml_file_is_a_mapping(tmp_path):
    path = tmp_path / "vessel.yml"
    path.write_text("kind: circle\nradius: 0.1\nelectrodes: 8\ncover: 0.4\n", encoding="utf-8")
    np.testing.assert_array_equal(read_vessel(path).transport_mesh().points, TANK.carrier(fine=False)[0].points)
    path.write_text("- a\n", encoding="utf-8")
    with pytest.raises(ValueError, match="vessel must be a YAML file"):
        read_vessel(path)


@pytest.mark.parametrize(("given", "message"), [
    (VESSEL | {"kind": "ball"}, "vessel.kind must be one of"), (VESSEL | {"radius": -1.0}, "vessel.radius"),
    (VESSEL | {"wdth": 1}, "has no wdth"), (VESSEL | {"width": 0.01}, "either width or cover, got both"),
    (VESSEL | {"direction": "left"}, "direction must be one of"), (VESSEL | {"electrodes": 0}, "vessel.electrodes"),
    ({"kind": "circle", "radius": 0.1}, "must have electrodes"),
    (PIPE | {"electrodes": 15}, "vessel.electrodes must be even"),
    (PIPE | {"flow": 4.5}, "vessel.flow must have mean_velocity"),
    (PIPE | {"flow": {"velocity_std": 1.0}}, "vessel.flow must have mean_velocity"),
    (PIPE | {"flow": {"mean_velocity": 1.0, "speed": 2.0}}, "vessel.flow must have mean_velocity"),
    (PIPE | {"flow": {"mean_velocity": -1.0}}, "flow.mean_velocity"),
    (CYLINDER | {"flow": {"mean_velocity": 1.0, "velocity_std": 0.1}}, "velocity_std must be 0 in a cylinder"),
    (VESSEL | {"flow": {"mean_velocity": 1.0}}, "vessel of kind circle has no flow")])
def test_bad_entries_are_named(given, message):
    with pytest.raises(ValueError, match=message):
        read_vessel(given)


@pytest.mark.parametrize("direction", ["counter-clockwise", "clockwise"])
def test_electrodes_are_where_the_instrument_has_them(direction):
    """The first at 90°, the third a quarter further in the direction of counting."""
    model = read_vessel(VESSEL | {"first": 90.0, "direction": direction}).electrode_model(1e-3)
    middles = [model.mesh.points[np.unique(facets)].mean(axis=0) for facets in model.electrodes]
    sign = 1 if direction == "clockwise" else -1
    assert np.argmax([y for _, y in middles]) == 0
    assert np.argmax([sign * x for x, _ in middles]) == 2


def write_ktc_mesh(path, first=1):
    """The coarse mesh of the tank in KTC's variables; node numbers from 1, as in MATLAB."""
    model = TANK.electrode_model(fine=False)
    faces = np.empty((8, 1), dtype=object)
    for row, facets in zip(faces, model.electrodes, strict=True):
        row[0] = np.asarray(facets) + first
    savemat(path, {"g": 100 * model.mesh.points, "H": model.mesh.cells + first, "elfaces": faces})
    return {"kind": "mesh", "file": str(path), "electrodes": 8, "scale": 0.01}


@pytest.mark.parametrize("first", [0, 1])
def test_a_mesh_file_has_the_voltages_of_the_same_tank(tmp_path, first):
    vessel = read_vessel(write_ktc_mesh(tmp_path / "mesh.mat", first))
    ours = TANK.electrode_model(fine=False)
    sigma = 0.2 * (1.0 + 3.0 * ours.mesh.points[:, 0])
    expected = CompleteElectrodeModel(ours.mesh, ours.electrodes, 1e-3).transfer_resistance(sigma)
    np.testing.assert_allclose(vessel.electrode_model(1e-3).transfer_resistance(sigma), expected, rtol=1e-9)


def test_a_body_is_found_on_a_mesh_file(tmp_path):
    """Within 2 cm, in a tank of 20 cm."""
    env = MeasuredEnv(moving(frames=4), write_ktc_mesh(tmp_path / "mesh.mat"), **BELIEVED)
    estimate = run_on_measurements(env, "log_walk_filter").mean[-1]
    at = 0.05 * np.array([np.cos(angle(31, 32)), np.sin(angle(31, 32))])
    assert np.linalg.norm(centroid(env.task.mesh.points, estimate) - at) < 0.02


@pytest.mark.parametrize(("change", "message"), [
    ({"electrodes": 9}, "vessel.electrodes must be 8, as in .*, got 9"), ({"scale": 0.0}, "scale must be"),
    ({"file": "none.mat"}, "vessel.file must be a mesh file")])
def test_bad_mesh_entries_are_named(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        read_vessel(write_ktc_mesh(tmp_path / "mesh.mat") | change)


def test_a_file_without_a_mesh_is_named(tmp_path):
    savemat(tmp_path / "a.mat", {"g": np.zeros((3, 2))})
    with pytest.raises(ValueError, match=r"a\.mat must hold H, elfaces"):
        read_vessel({"kind": "mesh", "file": str(tmp_path / "a.mat"), "electrodes": 8})
