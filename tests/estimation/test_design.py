"""Design criteria of all pairs at once agree with the textbook update for each pair."""

import numpy as np
import pytest
from eitbench.estimation.onboard.belief import pair_design_criteria, symmetric_entries
from eitbench.estimation.onboard.linearisation import electrode_pairs
from hypothesis import given, settings
from hypothesis import strategies as st
from models import textbook_update

L, N = 5, 9
PAIRS = electrode_pairs(L)


def a_state(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return random derivatives of 𝓡 (L, L, n), covariance, error weight and noise variances (pairs, L)."""
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(2, N, N))
    covariance, weight = roots @ roots.swapaxes(1, 2)
    derivative = rng.normal(size=(L, L, N))
    return derivative + derivative.swapaxes(0, 1), covariance, weight, rng.uniform(0.1, 10.0, (len(PAIRS), L))


def gains_of(derivative, covariance, weight, noise_variance):
    entries, number = symmetric_entries(L)
    rows = derivative.reshape(L * L, N)[entries]
    plain, weighted = (rows @ middle @ rows.T for middle in (covariance, covariance @ weight @ covariance))
    return pair_design_criteria(plain, weighted, number[PAIRS.T], noise_variance)


def textbook(matrix: np.ndarray, covariance: np.ndarray, noise_variance: np.ndarray) -> np.ndarray:
    return textbook_update(np.zeros(N), covariance, matrix, np.zeros(len(matrix)), noise_variance)[1]


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_criteria_are_the_reductions_by_the_update(seed):
    """The criteria of each pair are the reductions of tr(W P) and of ½ ln det P; measurements with infinite noise have
    no effect."""
    derivative, covariance, weight, noise_variance = a_state(seed)
    noise_variance[:, 2] = np.inf
    traces, bits = gains_of(derivative, covariance, weight, noise_variance)
    kept = np.arange(L) != 2
    for k, (i, j) in enumerate(PAIRS):
        after = textbook((derivative[i] - derivative[j])[kept], covariance, noise_variance[k, kept])
        assert traces[k] == pytest.approx(np.trace(weight @ (covariance - after)), rel=1e-6)
        ratio = np.linalg.slogdet(covariance)[1] - np.linalg.slogdet(after)[1]
        assert bits[k] == pytest.approx(0.5 * ratio, rel=1e-5, abs=1e-6)
