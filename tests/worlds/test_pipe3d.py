"""The 3D pipe: electrodes and injections are where they are said to be, and the truth is finer than the model."""

import numpy as np
import pytest

from eitbench.worlds import Pipe3D

SMALL = Pipe3D(electrode_rings=2, electrodes_per_ring=4, mean_velocity=16.0, scored_steps=2, frame=4)


@pytest.fixture(scope="module")
def model():
    """The estimators' model of the small pipe."""
    return SMALL.model()


def areas(cem):
    """(L,) of each electrode's triangles in m²."""
    sides = [np.diff(cem.mesh.points[facets], axis=1) for facets in cem.electrodes]
    return np.array([0.5 * np.linalg.norm(np.cross(side[:, 0], side[:, 1]), axis=1).sum() for side in sides])


def test_electrodes_have_their_size_and_place(model):
    """Each is as long as said and a part of the polygon around, and its middle lies at its angle and ring."""
    cem, scenario = model.observation.cem, SMALL
    arc = 2.0 * np.pi * scenario.radius / 4 * scenario.electrode_cover
    measured = areas(cem)
    assert len(measured) == 8 and np.ptp(measured) < 1e-12
    assert 0.98 * arc * scenario.electrode_length < measured[0] < arc * scenario.electrode_length     # chords
    for number, facets in enumerate(cem.electrodes):
        x, y, z = cem.mesh.points[np.unique(facets)].T
        ring, place = divmod(number, 4)
        assert np.ptp(z) == pytest.approx(scenario.electrode_length)
        assert 0.5 * (z.min() + z.max()) == pytest.approx((ring + 0.5) * scenario.length / 2)
        assert np.hypot(x, y) == pytest.approx(scenario.radius)
        assert np.angle(x.sum() + 1j * y.sum()) == pytest.approx((place * np.pi / 2 + np.pi) % (2 * np.pi) - np.pi,
                                                                 abs=1e-9) or place == 2


@pytest.mark.parametrize(("rings", "per_ring"), [(1, 4), (2, 4), (3, 6), (4, 8), (5, 8)])
def test_every_injection_injects(rings, per_ring):
    """One source and one sink, half a turn apart, odd injections within a ring; all rings take part in a frame."""
    scenario = Pipe3D(electrode_rings=rings, electrodes_per_ring=per_ring)
    currents = scenario.currents
    assert currents.shape == (16, rings * per_ring)
    sources, sinks = currents.argmax(axis=1), currents.argmin(axis=1)
    assert (np.sort(currents, axis=1)[:, 1:-1] == 0).all() and (currents.sum(axis=1) == 0).all()
    assert (currents.max(axis=1) == scenario.current).all()
    assert ((sinks - sources) % per_ring == per_ring // 2).all()
    assert (sources[::2] // per_ring == sinks[::2] // per_ring).all()
    assert set(sources // per_ring) == set(range(rings))


def test_slugs_enter_anywhere_within_seven_tenths_of_the_radius():
    """Places are even over the disc: the mean square distance is half the largest."""
    places = SMALL.draw_slug_places(np.random.default_rng(0), 20_000)
    distance = np.hypot(*places.T)
    assert distance.max() < 0.7 * SMALL.radius
    assert np.mean(distance**2) == pytest.approx(0.5 * (0.7 * SMALL.radius)**2, rel=0.02)
    assert np.abs(places.mean(axis=0)).max() < 0.02 * SMALL.radius


def test_inlet_is_the_first_section_and_flow_is_along_the_pipe(model):
    """Concentration enters over the whole of z = 0, with the mean velocity asked for."""
    transport = model.transport
    assert (transport.mesh.points[transport.inlet, 2] == 0).all()
    assert len(transport.inlet) == np.count_nonzero(transport.mesh.points[:, 2] == 0)
    transported = transport.step(np.zeros(transport.mesh.n_nodes), 1.0, 1.0)
    assert transported[transport.mesh.points[:, 2] < 0.02].mean() > 0.5 and transported.max() < 1.2


def test_truth_is_finer_than_the_model(model):
    """No inverse crime: four times the CD nodes, twice the EIT unknowns, half the sub-step; and n ≥ 3,000."""
    truth = SMALL.truth()
    assert model.transport.mesh.n_nodes >= 3000 and truth.transport.mesh.n_nodes > 4 * model.transport.mesh.n_nodes
    assert truth.observation.cem.n_unknowns > 1.8 * model.observation.cem.n_unknowns
    fine, coarse = (side.transport.time_step / side.transport.substeps for side in (truth, model))
    assert fine <= coarse / 2


@pytest.mark.parametrize(("change", "message"), [
    ({"electrode_rings": 0}, "electrode_rings must"), ({"electrodes_per_ring": 3}, "electrodes_per_ring must"),
    ({"electrode_length": 0.2}, "electrode_length must leave gaps"), ({"potential_order": 3}, "potential_order must"),
    ({"radius": -1.0}, "radius must"), ({"slug_width": (0.02, 0.01)}, "slug_width must be a range"),
])
def test_wrong_fields_are_named(change, message):
    """A wrong number is refused by its name."""
    with pytest.raises(ValueError, match=message):
        Pipe3D(**change)
