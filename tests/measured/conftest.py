import numpy as np
import pytest
from eitbench.envs.measured import MeasuredEnv
from eitbench.measured import vessel
from eitbench.numerics.round_meshes import electrode_disc, uniform_disc
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.worlds.vessels import RoundTank
from tanks import VESSEL, moving


def small_electrode_model(tank, fine):
    mesh = electrode_disc(tank.radius, tank.electrode_spans, *((8, 22) if fine else (2, 7)))
    return CompleteElectrodeModel(mesh, tank.electrodes(mesh), tank.contact_impedance)


@pytest.fixture(scope="module")
def coarse():
    """Estimate on 469 nodes of a tank instead of 1,261, with a third of the potential's unknowns."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RoundTank, "transport_mesh", lambda tank, fine: (
            uniform_disc(tank.radius, 12), np.empty(0, dtype=int)))
        patch.setattr(RoundTank, "electrode_model", small_electrode_model)
        vessel._transport_mesh.cache_clear()
        yield
    vessel._transport_mesh.cache_clear()


@pytest.fixture(scope="session")
def measurements():
    """An inclusion that moves half round the tank."""
    return moving(frames=6)


@pytest.fixture(scope="module")
def env(coarse, measurements):
    return MeasuredEnv(measurements, VESSEL, withheld=0.15)
