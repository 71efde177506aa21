"""Vessel files: shapes, numbering of electrodes, flows, and invalid entries; boreholes in a half-space: potentials of
point sources, pyGIMLi's files, and a buried body."""

from itertools import combinations

import numpy as np
import pytest
from eitbench.bench.runner import run_on_measurements
from eitbench.envs.measured import MeasuredEnv
from eitbench.measured import boreholes, read
from eitbench.measured.boreholes import BoreholePlane
from eitbench.measured.vessel import read_vessel
from eitbench.worlds.vessels import RoundTank
from tanks import CYLINDER, PIPE, VESSEL

TANK = RoundTank(radius=0.1, n_electrodes=8, electrode_coverage=0.4)
BOREHOLES = {"kind": "boreholes", "positions": [0.0, 0.5, 1.0], "depths": [0.2, 0.4, 0.6, 0.8]}
SIGMA = 0.02


def test_a_yaml_file_equals_a_mapping(tmp_path):
    path = tmp_path / "vessel.yml"
    path.write_text("kind: circle\nradius: 0.1\nelectrodes: 8\ncover: 0.4\n", encoding="utf-8")
    np.testing.assert_array_equal(read_vessel(path).transport_mesh().points, TANK.transport_mesh(fine=False)[0].points)
    path.write_text("- a\n", encoding="utf-8")
    with pytest.raises(ValueError, match="vessel must be a YAML file"):
        read_vessel(path)


@pytest.mark.parametrize(("entries", "message"), [
    (BOREHOLES | {"positions": [0.0]}, r"positions must be two or more numbers .* got \(0.0,\)"),
    (BOREHOLES | {"depths": [0.0, 0.2]}, "depths below the surface"),
    (VESSEL | {"kind": "ball"}, "vessel.kind must be one of"), (VESSEL | {"radius": -1.0}, "radius must be"),
    (VESSEL | {"wdth": 1}, "has no wdth"), (VESSEL | {"width": 0.01}, "either width or cover, got both"),
    (VESSEL | {"direction": "left"}, "direction must be one of"), (VESSEL | {"electrodes": 0}, "vessel.electrodes"),
    ({"kind": "circle", "radius": 0.1}, "must have electrodes"),
    (PIPE | {"electrodes": 15}, "vessel.electrodes must be even"),
    (PIPE | {"flow": {"velocity_std": 1.0}}, "vessel.flow must have mean_velocity"),
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


def four_point_errors(plane):
    """Return relative errors (k,) of resistances between dipoles of neighbouring electrodes of a borehole, against
    point sources in a half-space."""
    places = np.array([[x, -depth] for x in plane.positions for depth in plane.depths])
    distance = np.linalg.norm(places[:, None] - places, axis=2)
    image = np.hypot(places[:, None, 0] - places[:, 0], places[:, None, 1] + places[:, 1])
    with np.errstate(divide="ignore"):
        potentials = (1.0 / distance + 1.0 / image) / (4.0 * np.pi * SIGMA)
    model = plane.electrode_model(fine=False)
    computed = model.transfer_resistance(np.full(model.mesh.n_nodes, SIGMA)) / 2.0     # half of each current
    L = plane.n_electrodes
    dipoles = np.array([np.eye(L)[k] - np.eye(L)[k + 1] for k in range(L - 1) if (k + 1) % len(plane.depths)])
    apart = [(a, b) for a, b in combinations(dipoles, 2) if not (a * b).any()]
    potentials[np.eye(L, dtype=bool)] = 0.0                              # no electrode carries current and is measured
    return np.array([a @ computed @ b / (a @ potentials @ b) - 1.0 for a, b in apart])


def test_potentials_are_those_of_point_sources(monkeypatch):
    """The error is a tenth, which the calibration corrects, and becomes smaller on a finer mesh."""
    plane = BoreholePlane(tuple(BOREHOLES["positions"]), tuple(BOREHOLES["depths"]))
    coarse = np.median(np.abs(four_point_errors(plane)))
    for name in ("CELLS_ALONG", "CELLS_ACROSS", "LAYERS", "OUTER_CELLS", "SURFACE_CELLS"):
        monkeypatch.setattr(boreholes, name, 2 * getattr(boreholes, name))
    monkeypatch.setattr(boreholes, "EXTENT", 2.0)
    fine = np.median(np.abs(four_point_errors(plane)))
    assert fine < 0.4 * coarse and coarse < 0.12, (fine, coarse)


def unified(rows, electrodes=12):
    places = "\n".join(f"{k}\t-1" for k in range(electrodes))
    table = "\n".join("\t".join(map(str, row)) for row in rows)
    return f"{electrodes}# Number of sensors\n#x\tz\n{places}\n{len(rows)}# Number of data\n#a b m n r valid\n{table}\n"


def test_unified_files(tmp_path):
    """Each file is a frame; rows that a file lacks are missing."""
    rows = [(1, 2, 3, 4, 5.0, 1), (1, 2, 4, 5, -2.5, 1), (3, 4, 1, 2, 5.0, 0)]
    (tmp_path / "00.dat").write_text(unified(rows))
    (tmp_path / "01.dat").write_text(unified([(3, 4, 1, 2, 7.0, 1)]))
    measurements = read(tmp_path, current=0.1, frame_time=60.0)
    one, other = measurements.currents
    assert (one[0], one[1]) == (0.1, -0.1) and (other[2], other[3]) == (0.1, -0.1)
    assert [np.flatnonzero(row).tolist() for row in measurements.matrix] == [[0, 1], [2, 3], [3, 4]]
    np.testing.assert_allclose(measurements.voltages, [
        [np.nan, 0.5, -0.25], 3 * [np.nan], 3 * [np.nan], [0.7, np.nan, np.nan]])
    np.testing.assert_allclose(measurements.times, [0, 30, 60, 90])
    for text, message in ((unified([(1, 2, 3, 13, 5.0, 1)]), "electrodes from 1 to 12, got 1 to 13"),
                          (unified(rows).replace(" r ", " rhoa "), "unified format: .*KeyError: 'r'"),
                          (unified(rows, 11), "must have the 12 electrodes")):
        (tmp_path / "02.dat").write_text(text)
        with pytest.raises(ValueError, match=message):
            read(tmp_path)


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Files of a conductive body that moves from left to right, the first without the body."""
    folder = tmp_path_factory.mktemp("frames")
    with pytest.MonkeyPatch.context() as patch:                          # no inverse crime
        patch.setattr(boreholes, "CELLS_ACROSS", 5)
        patch.setattr(boreholes, "LAYERS", 9)
        model = read_vessel(BOREHOLES).electrode_model(1e-4)
    x, y, z = model.mesh.points.T
    random = np.random.default_rng(0)
    for k in range(9):
        body = np.exp(-((x - 0.12 * k)**2 + (y + 0.5)**2 + z**2) / 0.25**2)
        R = model.transfer_resistance(SIGMA * (1.0 + 2.0 * body * bool(k))) / 2.0
        rows = []
        for a in range(8):
            for m in set(range(11)) - {a, a + 4, a - 1, a + 3}:
                r = R[m, a] - R[m, a + 4] - R[m + 1, a] + R[m + 1, a + 4]
                rows.append((a + 1, a + 5, m + 1, m + 2, r * (1.0 + 1e-3 * random.normal()), 1))
        (folder / f"{k:02d}.dat").write_text(unified(rows))
    return folder


def test_a_buried_body_is_found(frames):
    """The conductivity of the ground is fitted; the filter predicts withheld resistances better, and sees the body
    where it is at last."""
    env = MeasuredEnv(read(frames), BOREHOLES, correction="gain")
    assert env.calibration.conductivity == pytest.approx(SIGMA, rel=0.02)
    found = run_on_measurements(env, "extended_kalman_filter")
    assert found.withheld_rmse < 0.6 * run_on_measurements(env, "homogeneous").withheld_rmse
    mesh = env.task.mesh
    inside = mesh.points[np.argmax(found.mean[-1])]
    assert np.hypot(*(inside - [0.96, -0.5])) < 0.25
    env.reset(seed=0)
    env.step(found.mean[0])
    env.render_mode = "rgb_array"
    assert env.render().ndim == 3
