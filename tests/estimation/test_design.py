"""What an injection teaches, for all pairs at once, against the textbook's update for each."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from eitbench.estimation import LinearisedObservations, kalman_filter, table_5_1
from eitbench.estimation.design import independent_rows, pair_gains, pair_tables
from eitbench.estimation.onboard.operator import electrode_pairs
from eitbench.numerics.fem import mass_matrix
from eitbench.numerics.mesh import rectangle_mesh
from eitbench.worlds.pipe2d import PIPE_2D
from eitbench.worlds.vessels import PlanePipe
from hypothesis import given, settings
from hypothesis import strategies as st
from models import LinearGaussian, dense_filter

L, N = 5, 9
PAIRS = electrode_pairs(L)


def a_state(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Derivatives of 𝓡 (L, L, n), covariance, weight of the errors, noise variances (pairs, L); all
    at random."""
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(2, N, N))
    covariance, weight = roots @ roots.swapaxes(1, 2)
    return rng.normal(size=(L, L, N)), covariance, weight, rng.uniform(0.1, 10.0, (len(PAIRS), L))


def gains_of(derivative, covariance, weight, noise_variance):
    rows = derivative.reshape(L * L, N)
    plain, weighted = (rows @ middle @ rows.T
                       for middle in (covariance, covariance @ weight @ covariance))
    return pair_gains(plain.reshape(L, L, L, L), weighted.reshape(L, L, L, L), PAIRS,
                      noise_variance)


def textbook(matrix: np.ndarray, covariance: np.ndarray, noise_variance: np.ndarray) -> np.ndarray:
    """P − P Hᵀ (H P Hᵀ + R)⁻¹ H P."""
    S = matrix @ covariance @ matrix.T + np.diag(noise_variance)
    return covariance - covariance @ matrix.T @ np.linalg.inv(S) @ matrix @ covariance


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_gains_are_what_the_update_takes_away(seed):
    """Of every pair: tr(W P) before less after, and half the logarithm of det P before over
    after."""
    derivative, covariance, weight, noise_variance = a_state(seed)
    traces, bits = gains_of(derivative, covariance, weight, noise_variance)
    for k, (i, j) in enumerate(PAIRS):
        after = textbook(derivative[i] - derivative[j], covariance, noise_variance[k])
        assert traces[k] == pytest.approx(np.trace(weight @ (covariance - after)), rel=1e-6)
        ratio = np.linalg.slogdet(covariance)[1] - np.linalg.slogdet(after)[1]
        assert bits[k] == pytest.approx(0.5 * ratio, rel=1e-5, abs=1e-6)


def test_endless_noise_is_no_reading():
    """Readings that will not be believed teach as much as readings that are not there."""
    derivative, covariance, weight, noise_variance = a_state(0)
    noise_variance[:, 2] = np.inf
    traces, bits = gains_of(derivative, covariance, weight, noise_variance)
    kept = np.arange(L) != 2
    for k, (i, j) in enumerate(PAIRS):
        after = textbook((derivative[i] - derivative[j])[kept], covariance, noise_variance[k, kept])
        assert traces[k] == pytest.approx(np.trace(weight @ (covariance - after)), rel=1e-8)
        ratio = np.linalg.slogdet(covariance)[1] - np.linalg.slogdet(after)[1]
        assert bits[k] == pytest.approx(0.5 * ratio, rel=1e-7)


# -- tables of a large state ----------------------------------------------------------------------


def test_tables_from_independent_rows():
    """For a symmetric 𝓡 with 𝓡1 = 0 they are the products over all L² rows."""
    derivative, covariance, weight, _ = a_state(1)
    derivative += derivative.swapaxes(0, 1)
    derivative -= derivative.mean(axis=1, keepdims=True)
    derivative -= derivative.mean(axis=0)
    rows, independent = derivative.reshape(L * L, N), independent_rows(derivative)
    tables = pair_tables(independent, covariance @ independent.T, weight)
    for table, middle in zip(tables, (covariance, covariance @ weight @ covariance), strict=True):
        expected = rows @ middle @ rows.T
        np.testing.assert_allclose(table.reshape(L * L, L * L), expected, rtol=0.0,
                                   atol=1e-12 * np.abs(expected).max())


@dataclass(frozen=True)
class CoarsePipe(PlanePipe):
    """With 495 nodes."""

    def carrier(self, fine):
        along = np.linspace(0.0, self.length, 45)
        across = np.linspace(-self.half_width, self.half_width, 11)
        return rectangle_mesh(along, across), np.arange(11)


def test_all_pairs_of_the_pipe():
    """A filter in mid-record, 495 nodes, against an update of the full covariance for each of the
    120 pairs."""
    world = replace(PIPE_2D, vessel=CoarsePipe())
    transport, observation = world.model()
    level = 30.0
    evolution = transport.evolution_model()
    assert len(evolution.F) == 495
    start = table_5_1(transport, world.prior, level, rank_tolerance=1e-6)
    noise = evolution.state_noise_covariance((level / 4)**2, (level / 50)**2)
    initial = (level / 4)**2 * np.eye(len(start.mean))
    model = LinearGaussian(evolution.F, start.forcing, noise, start.mean, initial)
    linearised = LinearisedObservations(observation, world.noise, start.mean)
    record = [linearised(np.zeros(16), currents) for currents in world.currents]
    covariance = dense_filter(model, record)[-1][0].covariance
    kalman_filter(start, record[:-1])
    start.predict()

    resistance, table = observation.resistance_derivatives(start.mean)
    derivative = np.moveaxis(table, 0, 2)
    weight = mass_matrix(transport.mesh)
    pairs = electrode_pairs(16)
    noise_variance = world.noise.std(resistance[pairs[:, 0]] - resistance[pairs[:, 1]])**2
    rows = independent_rows(derivative)
    cross = start.apply_covariance(rows.T)
    limit = start.covariance.limit @ rows.T
    np.testing.assert_array_equal(cross, start.apply_covariance(rows.T, limit))
    traces, bits = pair_gains(*pair_tables(rows, cross, weight), pairs, noise_variance)
    before = np.linalg.slogdet(covariance)[1]
    for k, (i, j) in enumerate(pairs):
        after = textbook(derivative[i] - derivative[j], covariance, noise_variance[k])
        assert traces[k] == pytest.approx(weight.multiply(covariance - after).sum(), rel=1e-10)
        # The determinants, of e to the power of thousands, leave fewer digits.
        assert bits[k] == pytest.approx(0.5 * (before - np.linalg.slogdet(after)[1]), rel=1e-9)
    assert np.ptp(traces) > 0.1 * traces.max() and np.ptp(bits) > 0.1 * bits.max()
