"""`eitbench.plot` and frames of animations: axes contain the given numbers."""

import eitbench
import gymnasium as gym
import matplotlib
import numpy as np
import pandas as pd
import pytest
from eitbench.bench.methods import load_method
from eitbench.bench.runner import iter_estimates
from eitbench.bench.tracks import Environment
from eitbench.envs.rendering import draw_frame
from eitbench.report.animate import animate
from matplotlib import pyplot as plt

from short import FAST, world

matplotlib.use("Agg")
PIPE, TANK, SOLID = "eitbench/Pipe2D-v0", "eitbench/RotatingTank2D-v0", "eitbench/Pipe3D-v0"
INJECTION = "eitbench/TankTracking-v0"


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


def task_of(name):
    return gym.make(name, **world(name)).unwrapped.task


def painted(ax):
    """Return the values of the last field drawn on axes."""
    return np.asarray(ax.collections[0].get_array())


def means_of(ax):
    """Return the titles of panels from bottom to top."""
    return [float(bar[0].get_xdata()[0]) for bar in ax.containers]


@pytest.mark.parametrize("name", [PIPE, TANK, SOLID])
def test_a_field_is_drawn_to_scale(name):
    """A plot is in cm, on given axes, in the colour scale of the task; it shows the mean of an estimate. A
    field of another mesh is rejected."""
    task = task_of(name)
    c = np.linspace(20.0, 40.0, task.mesh.n_nodes)
    ax = plt.subplots()[1]
    assert eitbench.plot.field(task, c, ax, currents=task.currents[0]) is ax
    again = eitbench.plot.field(task, eitbench.Estimate(c))
    np.testing.assert_array_equal(painted(ax), painted(again))
    if task.mesh.dim == 2:
        np.testing.assert_array_equal(painted(ax), c)
        size = 100 * np.ptp(task.mesh.points, axis=0)
        assert np.ptp(ax.get_xlim()) == pytest.approx(size[0]) and ax.get_xlabel() == "x / cm"
    colours = {tuple(np.round(each.get_color()[0][:3], 2)) for each in ax.collections[1:]}
    assert len(colours) > 1 or task.mesh.dim == 3        # source, sink and the others; in 3D electrodes in the section
    with pytest.raises(ValueError, match=rf"c must have shape \({task.mesh.n_nodes},\), got \(3,\)"):
        eitbench.plot.field(task, np.ones(3))
    with pytest.raises(ValueError, match="currents must have shape"):
        eitbench.plot.field(task, c, currents=np.ones(3))


def test_an_episode_shows_truth_and_estimate():
    """Plots show truth and estimate at the times of the titles; ẽ_c is the score."""
    given = world(PIPE)["world"]
    axes = eitbench.plot.episode("homogeneous", PIPE, "dev:0", world=given, times=2)
    assert axes.shape == (2, 2)
    asked = Environment(PIPE).make(world=given)
    said = dict(iter_estimates(asked, load_method("homogeneous", "estimation"), 100_000))
    errors = eitbench.evaluate("homogeneous", PIPE, "dev:0", world=given)["error"][0]
    told = []
    for truth, estimate in axes:
        t = round(float(truth.get_title().split()[3]) / (1e3 * asked.world.time_step))
        np.testing.assert_array_equal(painted(truth), asked.truth()[t - 1])
        np.testing.assert_array_equal(painted(estimate), said[t].mean)
        told.append(float(estimate.get_title().rpartition(" ")[2]))
    assert min(told) < 2 * errors and max(told) > errors / 2


def test_an_episode_of_a_policy(tmp_path):
    axes = eitbench.plot.episode("random_pair", INJECTION, 3, world=world(INJECTION)["world"], times=1)
    assert axes.shape == (1, 2) and "random_pair, ẽ_c =" in axes[0, 1].get_title()
    for method, seed, times, message in [
            ("homogeneous", 3, 6, "times must be an integer of at least 1 and at most 3, got 6"),
            ("fixed_interval_smoother", 3, 1, "method fixed_interval_smoother .* not compatible"),
            ("homogeneous", "dev:0-1", 1, "seed must name one episode, .*, got 'dev:0-1'")]:
        with pytest.raises(ValueError, match=message):
            eitbench.plot.episode(method, PIPE, seed, world=world(PIPE)["world"], times=times)
    with pytest.raises(ValueError, match=f"policy must be one for {INJECTION}, got a, b"):
        animate(INJECTION, ["a", "b"], "dev:0", None, tmp_path / "x.webp")


def test_methods_are_compared_best_first():
    """Each episode has a dot, the mean an interval; one table and several give the same."""
    tables = [pd.DataFrame({"environment": "a", "method": method, "seed": ["dev:0", "dev:1"], "error": errors,
                            "seconds_per_step": [0.002, 0.004]})
              for method, errors in (("worse", [0.3, 0.5]), ("better", [0.1, 0.2]))]
    for given in (tables, pd.concat(tables)):
        ax = eitbench.plot.compare(given)
        names = [label.get_text() for label in ax.get_yticklabels()]
        assert names == ["worse", "better"] and ax.get_xlabel() == "ẽ_c"
        assert means_of(ax) == pytest.approx([0.4, 0.15])
    assert means_of(eitbench.plot.compare(tables, score="seconds_per_step")) == pytest.approx([3.0, 3.0])
    with pytest.raises(ValueError, match=r"one of error, seconds_per_step; got 'eror'. Did you mean error"):
        eitbench.plot.compare(tables, score="eror")
    for nothing in ([], ["error"]):
        with pytest.raises(ValueError, match="table must be a DataFrame or several"):
            eitbench.plot.compare(nothing)


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
