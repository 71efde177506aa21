import pytest
from eitbench.envs.measured import MeasuredEnv
from tanks import VESSEL, moving


@pytest.fixture(scope="session")
def record():
    """A body that moves half round the tank."""
    return moving(frames=6)


@pytest.fixture(scope="session")
def env(record):
    return MeasuredEnv(record, VESSEL, withheld=0.15)
