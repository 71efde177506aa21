"""Observation model: conductivity laws, the chain rule, the minimum concentration, the noise formula."""

from __future__ import annotations

import numpy as np
import pytest
from eitbench.numerics.mesh import rectangle_mesh
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.physics.observation import LinearConductivity, ObservationModel, VoltageNoise
from numpy.testing import assert_allclose, assert_array_equal

from shapes import RootLaw

LAWS = [LinearConductivity(0.011), RootLaw()]
PATTERNS = np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.5, -1.5, 1.0], [0.3, 0.3, 0.3, -0.9]])
PATTERNS.setflags(write=False)
FLOOR = 2.0

each_law = pytest.mark.parametrize("law", LAWS, ids=lambda law: type(law).__name__)


def observation(law) -> ObservationModel:
    """Return a model of four electrodes on a rectangle, with a concentration on a non-conforming mesh."""
    eit_mesh = rectangle_mesh(np.linspace(0.0, 1.0, 7), np.linspace(0.0, 0.6, 5))
    cd_mesh = rectangle_mesh(np.linspace(0.0, 1.0, 5), np.linspace(0.0, 0.6, 4))
    electrodes = [eit_mesh.facets_where(lambda p, y=y, a=a: (np.abs(p[:, 1] - y) < 1e-9) & (p[:, 0] > a - 1e-9)
                                        & (p[:, 0] < a + 0.34)) for y in (0.0, 0.6) for a in (0.0, 0.5)]
    cem = CompleteElectrodeModel(eit_mesh, electrodes, 0.1)
    return ObservationModel(cem, cd_mesh.interpolation_to(eit_mesh.points), law, FLOOR)


def concentration(model: ObservationModel, low: float = 10.0, high: float = 60.0) -> np.ndarray:
    return np.random.default_rng(5).uniform(low, high, model.interpolation.shape[1])


def test_noise_formula():
    """std² = (1 % of the measurement)² + (0.1 % of the injection's largest voltage)² + floor², per injection."""
    voltages = np.array([[3.0, -4.0, 0.0], [0.1, 0.0, -0.05]])
    expected = np.sqrt([[0.03**2 + 0.004**2, 0.04**2 + 0.004**2, 0.004**2],
                        [0.001**2 + 0.0001**2, 0.0001**2, 0.0005**2 + 0.0001**2]])
    assert_allclose(VoltageNoise().std(voltages), expected, rtol=1e-14)
    assert_allclose(VoltageNoise(floor=0.02).std(voltages), np.sqrt(expected**2 + 0.02**2), rtol=1e-14)
    assert_allclose(VoltageNoise(0.0, 0.0, 0.02).std(voltages), 0.02)
    assert_allclose(VoltageNoise().std(voltages[0]), expected[0])


@each_law
def test_linearisation_of_the_observation(law):
    """dV/dc of each voltage and node equals central differences; the voltages equal the model's. A
    constant has no interpolation error: 𝓡(c) equals the electrode model's for σ(c)."""
    model = observation(law)
    c = concentration(model)
    voltages, jacobian = model.linearise(c, PATTERNS)
    assert jacobian.shape == (3, 4, len(c))
    ahead, behind = (np.stack([model.voltages(c + e, PATTERNS) for e in step * np.eye(len(c))], axis=-1)
                     for step in (1e-3, -1e-3))
    differences = (ahead - behind) / 2e-3
    assert_allclose(jacobian, differences, atol=1e-6 * np.abs(differences).max(axis=2).min())
    assert_allclose(voltages, model.voltages(c, PATTERNS), rtol=1e-13)
    assert_allclose(voltages, PATTERNS @ model.transfer_resistance(c), rtol=1e-12, atol=1e-14)
    sigma = np.full(model.cem.mesh.n_nodes, float(law(np.array(30.0))))
    R = model.transfer_resistance(np.full_like(c, 30.0))
    assert_allclose(R, model.cem.transfer_resistance(sigma), rtol=1e-12)


@each_law
def test_derivatives_of_a_homogeneous_concentration_are_sums_over_the_nodes(law):
    """The voltages of c·1 by ln c: c times the sum of the derivatives by all nodes, also below the minimum."""
    model = observation(law)
    for level in (30.0, 0.5 * model.min_concentration):
        voltages, jacobian = model.linearise(np.full(model.interpolation.shape[1], level), PATTERNS)
        computed, by_log = model.homogeneous(level, PATTERNS)
        assert_allclose(computed, voltages, rtol=1e-12, atol=1e-14 * np.abs(voltages).max())
        expected = level * jacobian.sum(axis=2)
        assert_allclose(by_log, expected, atol=1e-10 * np.abs(expected).max())


@each_law
def test_concentration_below_the_minimum_is_replaced(law):
    """Negative and tiny values give a positive σ and the voltages of the minimum concentration,
    with its slope. The arguments are unchanged."""
    model = observation(law)
    c = concentration(model)
    # A whole cross-section below the least concentration, so that some EIT nodes depend on such nodes only.
    low, at_floor = c.copy(), c.copy()
    low[:8], at_floor[:8] = -1e3, FLOOR
    assert np.isfinite(model.voltages(low, PATTERNS)).all()
    below = np.full_like(c, -5.0)
    voltages, jacobian = model.linearise(below, PATTERNS)
    assert_array_equal(below, -5.0)
    expected_voltages, expected = model.linearise(np.full_like(c, FLOOR), PATTERNS)
    assert_allclose(voltages, expected_voltages, rtol=1e-13)
    assert_allclose(jacobian, expected, rtol=1e-12)
    assert np.abs(jacobian).max() > 0
    # At EIT nodes that mix both, the mixture is limited, so the voltages differ from a state that is limited first.
    assert not np.allclose(model.voltages(low, PATTERNS), model.voltages(at_floor, PATTERNS), rtol=1e-6)


def test_wrong_concentrations_are_refused():
    """Non-finite values, wrong shapes, a nonpositive minimum concentration and a negative noise are rejected."""
    model = observation(LAWS[0])
    c = concentration(model)
    for bad in (c[:-1], np.where(np.arange(len(c)) == 2, np.nan, c)):
        with pytest.raises(ValueError, match="concentration must"):
            model.linearise(bad, PATTERNS)
    with pytest.raises(ValueError, match="min_concentration must be"):
        ObservationModel(model.cem, model.interpolation, LAWS[0], 0.0)
    with pytest.raises(ValueError, match=r"^relative must be"):
        VoltageNoise(relative=-0.01)
