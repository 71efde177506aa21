import pytest
from eitbench.envs.measured import MeasuredEnv
from tanks import VESSEL, moving


@pytest.fixture(scope="session")
def measurements():
    """An inclusion that moves half round the tank."""
    return moving(frames=6)


@pytest.fixture(scope="session")
def env(measurements):
    return MeasuredEnv(measurements, VESSEL, withheld=0.15)
