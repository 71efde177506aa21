"""Cross-correlation of cross sections finds transit times and the velocity of a known flow."""

from dataclasses import replace

import numpy as np
import pytest
from eitbench import make_task
from eitbench.bench.methods import load_method, load_module
from eitbench.worlds.catalogue import PIPE_2D_UNKNOWN

METHOD = load_method("cross_correlation", "estimation")
MODULE = load_module("cross_correlation", METHOD.path, METHOD.path.read_bytes())


@pytest.mark.parametrize("delay", [2.0, 3.25])
def test_the_correlation_is_largest_at_the_delay(delay):
    """A moving pattern has the correlation 1 at its delay, and lags without enough pairs have 0."""
    t = np.arange(40.0)[:, None]
    arrival = t - delay * np.arange(4) / 2.0
    signals = np.sin(0.3 * arrival) + 0.5 * np.sin(0.17 * arrival)
    lags = np.append(np.linspace(1.0, 5.0, 17), 35.0)
    found = MODULE.correlate(signals, 2, lags)
    assert lags[np.argmax(found)] == delay
    assert found.max() == pytest.approx(1.0, abs=2e-3)
    assert found[-1] == 0.0
    assert not MODULE.correlate(np.ones((40, 4)), 2, lags).any()


def test_averages_over_cross_sections():
    """They reproduce a linear function of the axial coordinate at the sections' centres."""
    task = make_task(PIPE_2D_UNKNOWN)
    weights, distance = MODULE.cross_sections(task)
    centres = weights @ task.mesh.points[:, 0]
    np.testing.assert_allclose(np.diff(centres[1:-1]), distance / MODULE.GAP, rtol=1e-6)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    assert abs(weights @ task.mesh.points[:, 1]).max() < 1e-9


def test_the_velocity_of_moving_slugs_is_found():
    """Slugs that move as in a flow of 3 m/s bring the estimate from 4.5 to 3 m/s, within half of the
    difference: images of one injection at a time are blurred along the pipe."""
    task = replace(make_task(PIPE_2D_UNKNOWN), n_steps=30)
    speed = 3.0 * 1.5 / MODULE.METER_FACTOR
    estimator = METHOD.make(task)
    for t in range(1, task.n_steps + 1):
        moved = task.mesh.points[:, 0] - speed * task.transport.time_step * t
        distance = moved[:, None] - [0.15, -0.25, -0.8]
        pattern = np.exp(-(distance / 0.1)**2).sum(axis=1)
        currents = task.currents[(t - 1) % len(task.currents)]
        voltages = task.observation.voltages(28.0 + 6.0 * pattern, currents[None])[0]
        estimate = estimator.update(voltages, currents)
    assert estimate.velocity[0] == pytest.approx(3.0, abs=0.75)
