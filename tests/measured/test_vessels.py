"""Vessel files: shapes, numbering of electrodes, flows, and invalid entries."""

import numpy as np
import pytest
from eitbench.bench.runner import run_on_measurements
from eitbench.envs.measured import case_env
from eitbench.measured.vessel import read_vessel
from eitbench.worlds.vessels import RoundTank
from scipy.ndimage import center_of_mass, label
from tanks import CYLINDER, PIPE, VESSEL

TANK = RoundTank(radius=0.1, n_electrodes=8, electrode_coverage=0.4)


def test_a_yaml_file_equals_a_mapping(tmp_path):
    path = tmp_path / "vessel.yml"
    path.write_text("kind: circle\nradius: 0.1\nelectrodes: 8\ncover: 0.4\n", encoding="utf-8")
    np.testing.assert_array_equal(read_vessel(path).transport_mesh().points, TANK.transport_mesh(fine=False)[0].points)
    path.write_text("- a\n", encoding="utf-8")
    with pytest.raises(ValueError, match="vessel must be a YAML file"):
        read_vessel(path)


@pytest.mark.parametrize(("entries", "message"), [
    (VESSEL | {"kind": "ball"}, "vessel.kind must be one of"), (VESSEL | {"radius": -1.0}, "radius must be"),
    (VESSEL | {"wdth": 1}, "has no wdth"), (VESSEL | {"width": 0.01}, "either width or cover, got both"),
    (VESSEL | {"direction": "left"}, "direction must be one of"), (VESSEL | {"electrodes": 0}, "vessel.electrodes"),
    ({"kind": "circle", "radius": 0.1}, "must have electrodes"),
    (PIPE | {"electrodes": 15}, "vessel.electrodes must be even"),
    (PIPE | {"flow": 4.5}, "vessel.flow must have mean_velocity"),
    (PIPE | {"flow": {"velocity_std": 1.0}}, "vessel.flow must have mean_velocity"),
    (PIPE | {"flow": {"mean_velocity": 1.0, "speed": 2.0}}, "vessel.flow must have mean_velocity"),
    (PIPE | {"flow": {"mean_velocity": -1.0}}, "mean_velocity must be a finite"),
    (CYLINDER | {"flow": {"mean_velocity": 1.0, "velocity_std": 0.1}}, "velocity_std must be 0 in a cylinder"),
    (VESSEL | {"flow": {"mean_velocity": 1.0}}, "vessel of kind circle has no flow")])
def test_invalid_entries_are_named(entries, message):
    with pytest.raises(ValueError, match=message):
        read_vessel(entries)


@pytest.mark.parametrize("direction", ["counter-clockwise", "clockwise"])
def test_electrodes_have_the_positions_of_the_description(direction):
    """The first of eight is at 90°, the third a quarter turn further in the direction of numbering."""
    model = read_vessel(VESSEL | {"first": 90.0, "direction": direction}).electrode_model(1e-3)
    middles = [model.mesh.points[np.unique(facets)].mean(axis=0) for facets in model.electrodes]
    sign = 1 if direction == "clockwise" else -1
    assert np.argmax([y for _, y in middles]) == 0
    assert np.argmax([sign * x for x, _ in middles]) == 2


def test_a_mesh_file_must_exist():
    with pytest.raises(ValueError, match=r"vessel.file must be a mesh file, got none\.msh"):
        read_vessel({"kind": "mesh", "file": "none.msh", "electrodes": 8})


PHOTOGRAPHS = {
    "kit4-2.3": [(0.063, 0.053, 1), (0.0355, -0.056, 1)], "kit4-4.1": [(-0.009, 0.091, 1), (0.040, -0.035, -1)],
    "kit4-4.4": [(0.069, -0.004, 1), (0.021, -0.057, -1)]}
"""Centroids of inclusions in m, read off photographs of the water's surface to about 2 mm; 1 is conductive."""


@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_inclusions_are_located_as_in_photographs(name):
    """The centroid error is less than 1 cm in a tank of 28 cm; requires public files in $EITBENCH_MEASURED."""
    try:
        env = case_env(name)
    except ValueError as error:
        pytest.skip(str(error))
    estimate = np.log(run_on_measurements(env, "log_map").mean[-1] / env.task.expected_concentration)
    x, y = np.meshgrid(*[np.linspace(-0.14, 0.14, 141)] * 2)
    inside = x**2 + y**2 < 0.139**2
    field = np.zeros_like(x)
    field[inside] = env.task.mesh.interpolation_to(np.stack([x[inside], y[inside]], axis=1)) @ estimate
    for x_true, y_true, sign in PHOTOGRAPHS[name]:
        near = np.hypot(x - x_true, y - y_true) < 0.02
        labels, _ = label(sign * field > 0.5 * (sign * field)[near].max())
        row, column = center_of_mass(labels == np.bincount(labels[near & (labels > 0)]).argmax())
        assert np.linalg.norm(-0.14 + 0.002 * np.array([column, row]) - [x_true, y_true]) < 0.01
