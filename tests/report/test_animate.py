"""Estimates of several baselines below one truth."""

import gymnasium as gym
import numpy as np
import pytest
from eitbench.envs.rendering import draw_frame
from eitbench.report.animate import animate

from short import FAST


def test_each_field_has_a_panel_of_its_own():
    """Panels are below each other in one colour scale: equal estimates have equal pixels, different ones have not."""
    env = gym.make("eitbench/Pipe2D-v0", world=FAST).unwrapped
    task = env.task
    low, high = (np.full(task.mesh.n_nodes, factor * task.expected_concentration) for factor in (0.6, 1.8))
    fields = [(name, task.mesh, values) for name, values in (("Truth", high), ("A", low), ("B", high))]
    frame = draw_frame(task, fields, task.currents[0], 0.005)
    assert frame.shape == (605, 720, 3) and frame.dtype == np.uint8
    shades = [frame[y, 360] for y in (100, 270, 445)]
    np.testing.assert_array_equal(shades[0], shades[2])
    assert np.abs(shades[0].astype(int) - shades[1]).max() > 100


def test_policies_are_drawn_alone(tmp_path):
    """Several policies are rejected: their measurements differ."""
    with pytest.raises(ValueError, match="policy must be one for eitbench/Pipe2DInjection-v0, got a, b"):
        animate("eitbench/Pipe2DInjection-v0", ["a", "b"], "dev:0", None, tmp_path / "x.webp")
