import numpy as np
import pytest
from eitbench.envs.measured import MeasuredEnv
from eitbench.measured import vessel
from eitbench.numerics.round_meshes import uniform_disc
from eitbench.worlds.vessels import RoundTank
from tanks import VESSEL, moving


@pytest.fixture(scope="module")
def coarse():
    """Estimate on 469 nodes of a tank instead of 1,261."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RoundTank, "transport_mesh", lambda tank, fine: (
            uniform_disc(tank.radius, 12), np.empty(0, dtype=int)))
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
