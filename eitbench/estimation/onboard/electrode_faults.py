"""Estimates of electrode faults from the innovations of a filter (docs/methods.md, 19)."""

from __future__ import annotations

from copy import copy

import numpy as np

from eitbench.worlds.instrument import Instrument

INTACT, BROKEN, LOOSE = range(3)
"""States of an electrode: in order, with a broken wire, or with a bad contact."""
MAX_SWEEPS = 8
"""Largest number of sweeps over the measurements of an injection."""
WEIGHT_TOLERANCE = 1e-3
"""Largest change of a weight in the last sweep."""
SIGNAL_FACTOR = 2.0
"""Factor of the predicted variance of a signal, so that errors of the model do not look like
faults."""
REJECTED_WEIGHT = 0.01
"""Weight at and below which a measurement is rejected."""
MIN_PROBABILITY = 1e-7
"""Lower bound of all probabilities before a measurement, so that it can revise them."""


class ElectrodeFaults:
    """Probabilities of the states of each electrode, in B episodes.

    They begin with the instrument's statistics, which the task specifies. A measurement has the
    density of each state; its predicted value depends on the other measurements of the injection.

    Parameters
    ----------
    instrument : Instrument
    shape : (B, L)
        Episodes and electrodes.
    n_steps : int
        Time steps of an episode, for the rate at which wires break.

    Attributes
    ----------
    probabilities : (B, L, 3)
        Of `INTACT`, `BROKEN` and `LOOSE`.
    """

    def __init__(self, instrument: Instrument, shape: tuple[int, int], n_steps: int) -> None:
        ranges = instrument.n_dead_range, instrument.n_failing_range, instrument.n_loose_range
        dead, failing, loose = (sum(each) / (2.0 * shape[1]) for each in ranges)
        self.probabilities = np.tile([1.0 - dead - loose, dead, loose], (*shape, 1))
        self._break_rate = failing / n_steps
        # an open input without interference measures zero
        self._interference_variance = max(instrument.interference, instrument.noise_floor, 1e-6)**2
        self._instrument = instrument

    def repeat(self, count: int) -> ElectrodeFaults:
        """Return the probabilities in ``count`` copies of the first episode."""
        copies = copy(self)
        copies.probabilities = np.repeat(self.probabilities[:1], count, axis=0)
        return copies

    def weights(self, driven: np.ndarray, probabilities: np.ndarray | None = None) -> np.ndarray:
        """Return the expected inverse noise variance (..., L) of each measurement, relative to an
        intact electrode, for the mask (..., L) of the driven electrodes; by default for the present
        probabilities."""
        p = self.probabilities if probabilities is None else probabilities
        # the resistance of a bad contact is unknown: its voltage while driven is not used
        return np.asarray(p[..., INTACT] + np.where(
            driven, 0.0, p[..., LOOSE] / self._instrument.loose_noise**2))

    def flow_probability(self, driven: np.ndarray) -> np.ndarray:
        """Return the probability (...) that the current flows through all ``driven`` electrodes
        (..., L)."""
        return np.where(driven, 1.0 - self.probabilities[..., BROKEN], 1.0).prod(axis=-1)

    def update(self, voltages: np.ndarray, innovation: np.ndarray, signal: np.ndarray,
               noise_variance: np.ndarray, currents: np.ndarray) -> np.ndarray:
        """Condition on the measurements of one step; return (B,) bool: the current flowed.

        Parameters
        ----------
        voltages, innovation : (B, L)
            Measured, and measured minus predicted, V.
        signal : (B, L, L)
            Predicted covariance of the voltages without noise, V².
        noise_variance : (B, L)
            Noise of intact electrodes, V².
        currents : (B, L)
            A (A/m in 2D).
        """
        driven = currents != 0.0
        self.probabilities *= 1.0 - self._break_rate
        self.probabilities[..., BROKEN] += self._break_rate
        np.maximum(self.probabilities, MIN_PROBABILITY, out=self.probabilities)
        self.probabilities /= self.probabilities.sum(axis=-1, keepdims=True)
        prior = self.flow_probability(driven)
        flowing = np.where(driven[..., None], [1.0, 0.0, 1.0], 1.0) * self.probabilities
        flowing /= flowing.sum(axis=-1, keepdims=True)
        variance = SIGNAL_FACTOR * signal.diagonal(axis1=1, axis2=2)
        with_flow = self._densities(voltages, innovation, variance, noise_variance, currents)
        without = self._densities_without_flow(voltages, voltages - innovation)
        evidence = np.log([prior, 1.0 - prior + MIN_PROBABILITY])
        evidence += [_mixture(flowing, with_flow), _mixture(self.probabilities, without)]
        injected = driven.any(axis=1)
        flows = injected & (evidence[0] > evidence[1])
        failed = injected & ~flows
        if failed.any():
            self._condition_on_failure(failed, driven[failed], prior[failed], without[failed])
        if flows.any():
            self.probabilities[flows] = self._sweep(
                flowing[flows], voltages[flows], innovation[flows], signal[flows],
                noise_variance[flows], currents[flows])
        return np.asarray(flows)

    def weigh(self, voltages: np.ndarray, innovation: np.ndarray, signal: np.ndarray,
              noise_variance: np.ndarray, currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Condition as `update` does; return the innovations, NaN where the measurement is
        rejected, and the noise variances of faulty electrodes, (B, L) each."""
        flows = self.update(voltages, innovation, signal, noise_variance, currents)
        weights = flows[:, None] * self.weights(currents != 0.0)
        used = weights > REJECTED_WEIGHT
        return np.where(used, innovation, np.nan), noise_variance / np.where(used, weights, 1.0)

    def _densities(self, voltages: np.ndarray, innovation: np.ndarray, variance: np.ndarray,
                   noise_variance: np.ndarray, currents: np.ndarray) -> np.ndarray:
        """Return the logarithmic densities (B, L, 3) of innovations by state, for ``variance`` of
        the signal."""
        instrument = self._instrument
        low, high = instrument.loose_resistance
        extra = (high - low)**2 / 12.0 * currents**2 + instrument.loose_noise**2 * noise_variance
        return np.stack([
            _log_density(innovation, variance + noise_variance),
            _log_density(voltages, self._interference_variance),
            _log_density(innovation - 0.5 * (low + high) * currents, variance + extra)], axis=-1)

    def _densities_without_flow(self, voltages: np.ndarray, predicted: np.ndarray) -> np.ndarray:
        """Return the logarithmic densities (B, L, 3) of voltages by state if no current flows."""
        smallest = 1e-3 * np.abs(predicted).max(axis=1, keepdims=True)
        zero = _log_density(voltages, self._instrument.noise_floor**2 + smallest**2)
        interference = _log_density(voltages, self._interference_variance)
        return np.stack([zero, interference, zero], axis=-1)

    def _condition_on_failure(self, failed: np.ndarray, driven: np.ndarray, flow: np.ndarray,
                              densities: np.ndarray) -> None:
        """Condition the ``failed`` episodes on voltages without a current: a driven wire is broken.
        ``flow`` is the prior probability of a current."""
        before = self.probabilities[failed]
        broken = before[..., BROKEN]
        broken = np.where(driven, broken / (1.0 - flow + MIN_PROBABILITY)[:, None], broken)
        broken = np.clip(broken, MIN_PROBABILITY, 1.0 - MIN_PROBABILITY)
        others = (1.0 - broken) / (1.0 - before[..., BROKEN])
        prior = before * others[..., None]
        prior[..., BROKEN] = broken
        self.probabilities[failed] = _posterior(prior, densities)

    def _sweep(self, prior: np.ndarray, voltages: np.ndarray, innovation: np.ndarray,
               signal: np.ndarray, noise_variance: np.ndarray, currents: np.ndarray) -> np.ndarray:
        """Return the probabilities (B, L, 3) given the measurements of a current that flows.

        Each measurement is compared with its prediction by the filter and the other measurements
        of the injection, which have the noise of their weights.
        """
        driven = currents != 0.0
        diagonal = np.arange(voltages.shape[1])
        after = prior.copy()
        weights = self.weights(driven, after)
        k = np.arange(len(voltages))             # episodes that have not converged
        for _ in range(MAX_SWEEPS):
            noise = noise_variance[k] / np.maximum(weights[k], 1e-6)
            S = signal[k]
            S[:, diagonal, diagonal] += noise
            inverse = np.linalg.inv(S)
            precision = inverse.diagonal(axis1=1, axis2=2)
            residual = (inverse @ innovation[k, :, None])[..., 0] / precision
            variance = SIGNAL_FACTOR * np.maximum(1.0 / precision - noise, 0.0)
            after[k] = _posterior(prior[k], self._densities(
                voltages[k], residual, variance, noise_variance[k], currents[k]))
            before = weights[k]
            weights[k] = self.weights(driven[k], after[k])
            k = k[(np.abs(weights[k] - before) > WEIGHT_TOLERANCE).any(axis=1)]
            if not len(k):
                break
        return after


def _log_density(values: np.ndarray, variance: np.ndarray | float) -> np.ndarray:
    """Return the logarithmic density of a normal distribution with mean zero."""
    return np.asarray(-0.5 * (values**2 / variance + np.log(2.0 * np.pi * variance)))


def _mixture(probabilities: np.ndarray, densities: np.ndarray) -> np.ndarray:
    """Return the logarithmic density (B,) of all L measurements, by state (B, L, 3)."""
    largest = densities.max(axis=-1, keepdims=True)
    relative = (probabilities * np.exp(densities - largest)).sum(axis=-1)
    return (np.log(np.maximum(relative, 1e-300)) + largest[..., 0]).sum(axis=-1)


def _posterior(prior: np.ndarray, densities: np.ndarray) -> np.ndarray:
    """Return the probabilities (B, L, 3) after measurements with these logarithmic densities."""
    joint = np.log(np.maximum(prior, 1e-300)) + densities
    joint = np.exp(joint - joint.max(axis=-1, keepdims=True))
    return joint / joint.sum(axis=-1, keepdims=True)
