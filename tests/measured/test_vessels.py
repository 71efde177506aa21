"""Vessel files: shapes, numbering of electrodes, flows, and invalid entries."""

import numpy as np
import pytest
from eitbench.measured.vessel import read_vessel
from eitbench.worlds.vessels import RoundTank
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
    (VESSEL | {"flow": {"mean_velocity": 1.0}}, "vessel of kind circle has no flow"),
    ({"kind": "mesh", "file": "none.msh", "electrodes": 8}, r"vessel.file must be a mesh file, got none\.msh")])
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
