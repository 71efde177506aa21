"""Predictions in ap_gym, which is not among the dependencies of the tests: `pip install ap_gym`."""

import numpy as np
import pytest

from short import SHORT

ap_gym = pytest.importorskip("ap_gym")
from test_learning import example  # noqa: E402 (its example needs ap_gym)

ID = "eitbench/TankTracking-v0"


def test_the_true_image_has_no_loss():
    """A prediction of the target is free, another one costs its mean squared error; episodes repeat."""
    module = example("active_perception")
    env = module.ActiveInjection(ID, world=SHORT["TankTracking"])
    assert isinstance(env, ap_gym.BaseActivePerceptionEnv) and env.action_space.contains(env.action_space.sample())
    observation, info = env.reset(seed=3)
    assert env.observation_space.contains(observation)
    first = target = info["prediction"]["target"]
    boxes = target.reshape(6, 6)[1:5, 1:5]
    assert boxes.min() < -0.01 and np.isfinite(target).all()               # the body is less conductive
    for off in (0.0, 0.06):
        _, reward, *_, info = env.step({"action": 5, "prediction": target + np.float32(off)})
        assert reward == pytest.approx(-(off / module.TARGET_STD)**2, abs=1e-5)
        np.testing.assert_array_equal(info["prediction"]["target"], target)
        target = env._target()
    np.testing.assert_array_equal(env.reset(seed=3)[1]["prediction"]["target"], first)
