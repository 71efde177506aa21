"""`eitbench estimate` on files of other makers and in other vessels: a body is found where it is."""

import numpy as np
import pytest
import yaml
from eitbench.data.measured import Measurements
from eitbench.estimation.measured.vessel import read_vessel
from scipy.io import savemat
from tanks import VESSEL, instrument

from commands import eitbench

PIPE = {"kind": "rectangle", "length": 0.3, "width": 0.1, "electrodes": 8, "cover": 0.5}
CYLINDER = {"kind": "cylinder", "length": 0.2, "radius": 0.05, "rings": 2, "electrodes": 4, "height": 0.04,
            "cover": 0.5}


def readings(vessel, at, radius, ratio=0.3, noise=1e-3):
    """(2, 8, 8) V of homogeneous fluid, and with a body that conducts less there; contacts of their own."""
    model = read_vessel(vessel).electrode_model(1e-3 * np.linspace(0.8, 1.2, 8))
    far = np.linalg.norm(model.mesh.points - at, axis=1)
    currents, matrix = instrument()
    empty, full = (currents @ model.transfer_resistance(sigma) @ matrix.T
                   for sigma in (np.full(len(far), 0.2), 0.2 * np.where(far < radius, ratio, 1.0)))
    random = np.random.default_rng(0)
    return np.stack([exact * (1.0 + noise * random.normal(size=(8, 8))) for exact in (empty, full)])


def found(folder, file, vessel):
    """(d,) the middle of what conducts less than half as well as the extreme does, in m."""
    (folder / "vessel.yml").write_text(yaml.safe_dump(vessel))
    code, _, err = eitbench("estimate", file, "--vessel", folder / "vessel.yml", "--baseline", "log_map", "--still",
                            "--out", folder / "page.html", "--arrays", folder / "said.npz")
    assert code == 0, err
    with np.load(folder / "said.npz") as said:
        u = np.log(said["mean"][-1])
        less = np.maximum(np.median(u) - u, 0.0)
        less[less < 0.5 * less.max()] = 0.0
        return less @ said["points"] / less.sum()


@pytest.mark.parametrize("maker", ["ktc", "kit4"])
def test_files_of_kuopio(tmp_path, maker):
    """In mA and V, with the empty tank's file beside; within 1 cm, in a tank of 20 cm."""
    at = np.array([-0.03, 0.04])
    empty, full = readings(VESSEL, at, 0.025)
    currents, matrix = instrument()
    if maker == "ktc":
        ours = {"Mpat": matrix.T, "Inj": 1e3 * currents.T, "Uel": full.reshape(-1, 1)}
        savemat(tmp_path / "data1.mat", ours)
        savemat(tmp_path / "ref.mat", {"Mpat": matrix.T, "Injref": 1e3 * currents.T, "Uelref": empty.reshape(-1, 1)})
        file = tmp_path / "data1.mat"
    else:
        for name, values in (("datamat_1_0.mat", empty), ("datamat_2_1.mat", full)):
            savemat(tmp_path / name, {"CurrentPattern": 1e3 * currents.T, "MeasPattern": matrix.T, "Uel": values.T})
        file = tmp_path / "datamat_2_1.mat"
    assert np.linalg.norm(found(tmp_path, file, VESSEL) - at) < 0.01


@pytest.mark.parametrize(("vessel", "at", "radius", "off"), [
    (PIPE, [0.12, 0.02], 0.02, 0.02),
    pytest.param(CYLINDER, [0.02, 0.02, 0.08], 0.02, 0.03, marks=pytest.mark.slow)], ids=["pipe", "cylinder"])
def test_other_vessels(tmp_path, vessel, at, radius, off):
    """Few electrodes see little: within 2 cm, in a pipe of 30 cm, and 3 cm, in one of 20 cm."""
    empty, full = readings(vessel, np.array(at), radius)
    currents, matrix = instrument()
    record = Measurements(currents, np.arange(8), matrix, full, np.arange(8.0), empty[None], {"file": "pipe"})
    assert np.linalg.norm(found(tmp_path, record.save(tmp_path / "pipe.h5"), vessel) - at) < off
