"""The 3D pipe: electrode positions, injections and inlet."""

import numpy as np
import pytest
from eitbench.worlds.catalogue import PIPE_3D

SMALL = PIPE_3D.with_changes({
    "vessel": {"electrode_rings": 2, "electrodes_per_ring": 4}, "flow": {"mean_velocity": 16.0},
    "schedule": {"scored_steps": 2, "pattern": {"frame": 4}}})


def test_electrodes_inlet_and_flow():
    """Each electrode has the specified length and fraction of the circumference, centred at its
    angle and ring. Concentration enters over the whole of z = 0, with the requested mean
    velocity."""
    transport, observation = SMALL.estimator_model()
    cem, pipe = observation.cem, SMALL.vessel
    arc = 2.0 * np.pi / 4 * pipe.electrode_coverage
    for number, facets in enumerate(cem.electrodes):
        x, y, z = cem.mesh.points[np.unique(facets)].T
        ring, place = divmod(number, 4)
        assert np.ptp(z) == pytest.approx(pipe.electrode_length)
        assert 0.5 * (z.min() + z.max()) == pytest.approx((ring + 0.5) * pipe.length / 2)
        assert np.hypot(x, y) == pytest.approx(pipe.radius)
        angles = np.angle((x + 1j * y) * np.exp(-0.5j * np.pi * place))                 # relative to its centre
        np.testing.assert_allclose([angles.min(), angles.max()], [-0.5 * arc, 0.5 * arc], atol=1e-9)
    assert len(cem.electrodes) == 8
    z = transport.mesh.points[:, 2]
    np.testing.assert_array_equal(np.sort(transport.inlet), np.flatnonzero(z == 0))
    transported = transport.step(np.zeros(len(z)), 1.0, 1.0)
    assert transported[z < 0.02].mean() > 0.5 and transported.max() < 1.2


@pytest.mark.parametrize(("rings", "per_ring"), [(1, 4), (2, 4), (3, 6), (4, 8), (5, 8)])
def test_every_injection_injects(rings, per_ring):
    """Pairs are half a turn apart, odd injections within a ring; a frame uses all rings."""
    world = PIPE_3D.with_changes({"vessel": {"electrode_rings": rings, "electrodes_per_ring": per_ring}})
    currents = world.currents
    assert currents.shape == (16, rings * per_ring)
    sources, sinks = currents.argmax(axis=1), currents.argmin(axis=1)
    assert (np.sort(currents, axis=1)[:, 1:-1] == 0).all() and (currents.sum(axis=1) == 0).all()
    assert (currents.max(axis=1) == world.instrument.current).all()
    assert ((sinks - sources) % per_ring == per_ring // 2).all()
    assert (sources[::2] // per_ring == sinks[::2] // per_ring).all()
    assert set(sources // per_ring) == set(range(rings))
