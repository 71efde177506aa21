"""A tank on a mesh of KTC's format: the same voltages as our own tank on that mesh, and records estimated on it."""

import os
from pathlib import Path

import numpy as np
import pytest
from eitbench.bench.measured import play_record
from eitbench.envs.measured import MeasuredEnv
from eitbench.estimation.measured.vessel import read_vessel
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.worlds.vessels import RoundTank
from scipy.io import savemat
from tanks import angle, moving

REAL = os.environ.get("EITBENCH_REAL_FILES")
TANK = RoundTank(radius=0.1, n_electrodes=8, electrode_cover=0.4)


def written(path, first=1):
    """Our tank's coarse mesh in KTC's variables; node numbers from 1, as MATLAB counts."""
    model = TANK.electrode_model(fine=False)
    faces = np.empty((8, 1), dtype=object)
    for row, facets in zip(faces, model.electrodes, strict=True):
        row[0] = np.asarray(facets) + first
    savemat(path, {"g": 100 * model.mesh.points, "H": model.mesh.cells + first, "elfaces": faces})
    return {"kind": "mesh", "file": str(path), "electrodes": 8, "scale": 0.01}


@pytest.mark.parametrize("first", [0, 1])
def test_voltages_are_those_of_the_same_tank(tmp_path, first):
    vessel = read_vessel(written(tmp_path / "mesh.mat", first))
    ours = TANK.electrode_model(fine=False)
    sigma = 0.2 * (1.0 + 3.0 * ours.mesh.points[:, 0])
    expected = CompleteElectrodeModel(ours.mesh, ours.electrodes, 1e-3).transfer_resistance(sigma)
    np.testing.assert_allclose(vessel.electrode_model(1e-3).transfer_resistance(sigma), expected, rtol=1e-9)


def test_a_body_is_found_on_it(tmp_path):
    """Within 2 cm of where it is, in a tank of 20 cm."""
    record = moving(frames=4)
    env = MeasuredEnv(record, written(tmp_path / "mesh.mat"), initial_std=0.2, walk_std=0.05)
    estimate = play_record(env, "log_walk_filter").mean[-1]
    less = np.maximum(1.0 - estimate / np.median(estimate), 0.0)
    less[less < 0.5 * less.max()] = 0.0
    at = 0.05 * np.array([np.cos(angle(31, 32)), np.sin(angle(31, 32))])
    assert np.linalg.norm(less @ env.task.mesh.points / less.sum() - at) < 0.02


@pytest.mark.parametrize(("change", "words"), [
    ({"electrodes": 9}, "vessel.electrodes must be as many as in .*, 8, got 9"), ({"scale": 0.0}, "scale must be")])
def test_what_does_not_fit_is_said(tmp_path, change, words):
    with pytest.raises(ValueError, match=words):
        read_vessel(written(tmp_path / "mesh.mat") | change)


def test_a_file_without_a_mesh_is_named(tmp_path):
    savemat(tmp_path / "a.mat", {"g": np.zeros((3, 2))})
    with pytest.raises(ValueError, match=r"a\.mat must hold H, elfaces"):
        read_vessel({"kind": "mesh", "file": str(tmp_path / "a.mat"), "electrodes": 8})


@pytest.mark.skipif(not REAL, reason="EITBENCH_REAL_FILES names no folder of real files")
def test_the_real_mesh_explains_a_real_record():
    """Of KTC's first tank: withheld readings are missed by less than twice the noise."""
    folder = Path(REAL) / "ktc"
    vessel = {"kind": "mesh", "file": str(folder / "Mesh_sparse.mat"), "electrodes": 32, "depth": 0.07}
    env = MeasuredEnv(folder / "TrainingData" / "data1.mat", vessel)
    assert play_record(env, "log_map").withheld < 2.0
