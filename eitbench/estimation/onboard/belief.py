"""Belief of an injection policy: the filter inside the environment, rerun from its observations,
and the design criteria of the next injection."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from eitbench.data.episode_cache import scoring_constants
from eitbench.estimation.onboard.electrode_faults import REJECTED_WEIGHT
from eitbench.estimation.onboard.linearisation import Linearisation, linearisation_table
from eitbench.estimation.onboard.reduced_filters import ReducedFilters
from eitbench.estimation.onboard.rules import Rules

FAULT_THRESHOLD = 0.3
"""`Belief.fault_score` from which an electrode counts as faulty."""
FAULT_DECAY = 0.8
"""Factor per step of the score after failed injections, while the electrode is not driven."""


def symmetric_entries(n_electrodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices (N,) of the upper triangle in 𝓡 (L, L) as L² numbers, and the row (L, L)
    of each entry among them."""
    rows, columns = np.triu_indices(n_electrodes)
    number = np.empty((n_electrodes, n_electrodes), dtype=int)
    number[rows, columns] = number[columns, rows] = np.arange(len(rows))
    return rows * n_electrodes + columns, number


def pair_design_criteria(
        voltage_covariance: np.ndarray, weighted_voltage_covariance: np.ndarray,
        entries: tuple[np.ndarray, np.ndarray],
        noise_variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the A- and D-criterion of an injection through each pair, (p,) and (p,).

    They are the reduction of tr(W P) (A-optimality) and half the reduction of ln det P
    (D-optimality). D (N, n) holds the derivatives of the entries of 𝓡 by the n states. The voltages
    are bilinear in the driving pair and the measuring electrode, so one table of products of the
    covariance serves every pair (``docs/methods.md``, 8); 𝓡 is symmetric, with N = L(L + 1)/2
    different entries.

    Parameters
    ----------
    voltage_covariance : (N, N)
        D P Dᵀ, with the state's covariance P just before the measurement.
    weighted_voltage_covariance : (N, N)
        D P W P Dᵀ, with the weight W of state errors.
    entries : (p, m) and (p, m)
        Rows of D whose difference is the derivative of each of a pair's m voltages, from
        `symmetric_entries`: of the electrodes where the current enters and leaves.
    noise_variance : (p, m)
        Noise of the voltages, per current squared; infinite for rejected measurements.
    """
    signal, weighted = _whitened(entries, noise_variance, voltage_covariance,
                                 weighted_voltage_covariance)
    S = signal + np.eye(signal.shape[1])
    gains = (np.linalg.inv(S) * weighted).sum(axis=(1, 2))
    return gains, 0.5 * np.linalg.slogdet(S)[1]


def best_electrodes(
        voltage_covariance: np.ndarray, weighted_voltage_covariance: np.ndarray,
        entries: tuple[np.ndarray, np.ndarray], noise_variance: np.ndarray,
        count: int) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Return the places (p, count) of voltages of each pair among its m, and the A- and D-criterion
    (p,) of these voltages: the first one has the largest A-criterion, and each further one
    increases the criterion most. Arguments as in `pair_design_criteria`."""
    S, W = _whitened(entries, noise_variance, voltage_covariance, weighted_voltage_covariance)
    pairs = np.arange(len(S))
    free = np.ones(S.shape[:2], dtype=bool)
    chosen = np.empty((len(S), count), dtype=int)
    gains, information = np.zeros((2, len(S)))
    for k in range(count):
        variance = np.diagonal(S, axis1=1, axis2=2) + 1.0
        increase = np.where(free, np.diagonal(W, axis1=1, axis2=2) / variance, -1.0)
        best = chosen[:, k] = increase.argmax(axis=1)
        free[pairs, best] = False
        gains += increase[pairs, best]
        information += 0.5 * np.log(variance[pairs, best])
        # condition on this voltage: S − s sᵀ/σ², and likewise the rows and columns of W
        row, weighted = S[pairs, best], W[pairs, best]
        share = row / variance[pairs, best, None]
        W = (W - share[:, :, None] * weighted[:, None] - weighted[:, :, None] * share[:, None]
             + weighted[pairs, best, None, None] * share[:, :, None] * share[:, None])
        S = S - share[:, :, None] * row[:, None]
    return chosen, (gains, information)


def _whitened(entries: tuple[np.ndarray, np.ndarray], noise_variance: np.ndarray,
              *tables: np.ndarray) -> list[np.ndarray]:
    """Return the products (p, m, m) of each pair's voltages relative to their noise, from tables
    (N, N) as in `pair_design_criteria`."""
    i, j = entries
    root = 1.0 / np.sqrt(noise_variance)              # zero for rejected measurements
    scale = root[:, :, None] * root[:, None, :]
    flat = [one[:, :, None] * len(tables[0]) + other[:, None, :]
            for one, other in ((i, i), (i, j), (j, j))]
    whitened = []
    for table in tables:
        entering, mixed, leaving = (table.take(each) for each in flat)
        whitened.append(scale * (entering + leaving - mixed - mixed.swapaxes(1, 2)))
    return whitened


class Belief:
    """Covariance of the environment's filter, and the design criteria of each injection.

    It is created from the first raw observation of an episode and updated with every later one. The
    state is reduced (120 coordinates), relative to c_ref, with the mass matrix as the identity: the
    trace of its covariance is the expected squared error, integrated. If the velocity is estimated,
    the mean velocity (m/s) is the last of the s entries.
    """

    def __init__(self, rules: Rules, observation: dict[str, np.ndarray]) -> None:
        self.rules = rules
        self.filters = ReducedFilters(rules, observation["frame"][None])
        self._shared = self.filters.shared
        self._true_states: np.ndarray | None = None
        self._clear_cache()
        measuring, self._driving = observation["doubt"]
        self.fault_score = measuring + self._driving
        """(L,) fraction of an electrode's recent measurements that were rejected, plus the fraction
        of recent injections through it that failed; or the probability that it has a fault"""

    @classmethod
    def from_prior(cls, rules: Rules) -> Belief:
        """Return the belief after a first frame without faults and noise at the expected c_ref."""
        frame = rules.world.currents @ linearisation_table(rules.world).linearisation(0).resistance
        return cls(rules, {"frame": frame, "doubt": np.zeros((2, frame.shape[1]))})

    @staticmethod
    def suits(rules: Rules) -> bool:
        """Return whether the filter of these rules has a covariance; otherwise see `BodyBelief`."""
        return not rules.tracks_body

    def update(self, observation: dict[str, np.ndarray]) -> None:
        """Assimilate the outcome of the last injection.

        A failed injection does not identify which of its two electrodes is faulty, so both scores
        rise. While an electrode is not driven, its score decays; a faulty one keeps a high score,
        since it measures interference.
        """
        self.filters.assimilate(observation["voltages"][None], observation["currents"][None])
        self._true_states = None
        self._clear_cache()
        measuring, driving = observation["doubt"]
        if self.filters.faults is None:
            driving = np.where(observation["currents"] == 0.0, FAULT_DECAY * self._driving, driving)
        self._driving = driving
        self.fault_score = measuring + self._driving

    def condition_on_truth(self, entries: np.ndarray) -> None:
        """Linearise later steps about the truth, the entries of the cached episode from the present
        t on; for oracles only. ``ValueError`` with a learned inflow."""
        if self.rules.inflow == "learned":
            raise ValueError("inflow must be 'white' for true states, got 'learned': the cached "
                             "episode does not include the inflow")
        world = self.rules.world
        level = self.filters.c_ref[0]
        mass = scoring_constants(world).mass
        whole = 0.5 * (mass.sum(axis=0) + mass.sum(axis=1))  # ∫ of each basis function
        beyond = (world.background - level) * whole + entries["moment"]
        states = beyond @ self._shared.states.basis / level
        flow = world.velocity_model
        if flow is not None:
            square = flow.profiles[:, 0]**2 @ flow.weights
            states = np.column_stack([states, entries["velocity_moment"][:, 0] / square])
        self._true_states = states
        self._clear_cache()

    def _clear_cache(self) -> None:
        self._steps: list[tuple[np.ndarray, ...]] = []
        for cached in ("linearisation", "_weight", "_noise_variance"):
            vars(self).pop(cached, None)

    @property
    def _state(self) -> np.ndarray:
        """(s,) present mean in double precision."""
        return self.filters.filter.mean[0].astype(float)

    @property
    def mean(self) -> np.ndarray:
        """(n,) estimate in mol/m³ at the nodes of the task's mesh."""
        return self.filters.means()[0]

    @property
    def healthy_electrodes(self) -> np.ndarray:
        """(L,) bool: electrodes whose fault score is below the threshold."""
        return np.asarray(self.fault_score < FAULT_THRESHOLD)

    @property
    def most_reliable_pair(self) -> int:
        """Pair with the lowest fault score, for injections with too few healthy electrodes."""
        return int(self.fault_score[self.rules.pairs].sum(axis=1).argmin())

    def predict_covariance(self, covariance: np.ndarray | None = None,
                           steps_ahead: int = 0) -> np.ndarray:
        """Return the covariance (s, s) one step later, before its measurement.

        It is propagated from the present covariance, or from ``covariance``, which holds
        ``steps_ahead`` steps from now. That number matters if the velocity is estimated, since the
        effect of a velocity error depends on the concentration.
        """
        transition, noise, _ = self._step(steps_ahead)
        if covariance is None:
            covariance = self.filters.filter.covariance[0].astype(float)
        return transition @ covariance @ transition.T + noise

    def _step(self, steps_ahead: int) -> tuple[np.ndarray, ...]:
        """Return the Jacobian of the step that starts ``steps_ahead`` steps from now, its noise
        covariance and the mean after it, linearised at the predicted mean or the true state."""
        for k in range(len(self._steps), steps_ahead + 1):
            before = self._steps[-1][2] if self._steps else self._state
            if self._true_states is not None:
                before = self._true_states[k]
            self._steps.append(self._shared.states.step(before))
        return self._steps[steps_ahead]

    def expected_error(self, covariance: np.ndarray) -> float:
        """Return the expected squared error, integrated over the scored region, relative to
        c_ref²."""
        return float((self._weight * covariance).sum())

    def future_error_weight(self, steps: int, steps_ahead: int = 0) -> np.ndarray:
        """Return the weight (s, s) of an error at the next measurement (the first after
        ``steps_ahead`` more steps) in the sum of squared errors over the scored region, at that
        time and over ``steps`` later steps of the flow.
        """
        weight = total = self._weight
        # An episode has one state more than steps.
        last = (len(self._true_states) - 1 if self._true_states is not None
                else steps_ahead + steps + 1)
        for k in range(min(steps_ahead + steps, last - 1), steps_ahead, -1):
            transition = self._step(k)[0]
            total = weight + transition.T @ total @ transition
        return total

    def design_criteria(self, covariance: np.ndarray, healthy: np.ndarray | None = None,
                        jacobian: np.ndarray | None = None,
                        weight: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the A- and D-criterion of each pair, (pairs,) each, for a state with this
        covariance; see `pair_design_criteria`.

        Electrodes that are not ``healthy`` contribute no measurement, and pairs with one of them
        score 0. Estimated faults increase the noise, and the criteria are multiplied by the
        probability that the current flows. By default ``jacobian`` belongs to `linearisation`, and
        ``weight`` is for present errors in the scored region.
        """
        jacobian = self.linearisation.jacobian if jacobian is None else jacobian
        entries, number = symmetric_entries(len(jacobian))
        D = jacobian.reshape(len(jacobian)**2, -1)[entries]
        DP = D @ covariance
        variance = self._noise_variance
        if healthy is not None:
            variance = np.where(healthy, variance, np.inf)
        weight = self._weight if weight is None else weight
        criteria = pair_design_criteria(DP @ D.T, DP @ weight @ DP.T,
                                        number[self.rules.pairs.T], variance)
        usable = np.ones(len(self.rules.pairs))
        if self.filters.faults is not None:
            usable = self.filters.faults.flow_probability(self._driven)
        if healthy is not None:
            usable = usable * healthy[self.rules.pairs].all(axis=1)
        return criteria[0] * usable, criteria[1] * usable

    def criteria(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the A- and D-criterion of each pair, (pairs,) each, of the next injection,
        linearised about the estimate."""
        return self.design_criteria(self.predict_covariance(),
                                    jacobian=self.relinearised_jacobian())

    def posterior_covariance(self, covariance: np.ndarray, pair: int,
                             healthy: np.ndarray | None = None) -> np.ndarray:
        """Return the covariance (s, s) after an injection through this pair."""
        i, j = self.rules.pairs[pair]
        variance = self._noise_variance[pair]
        jacobian = self.linearisation.jacobian
        matrix = (jacobian[i] - jacobian[j]) / np.sqrt(variance)[:, None]
        if healthy is not None:
            if not healthy[[i, j]].all():
                return covariance
            matrix = matrix[healthy]
        cross = matrix @ covariance
        root = np.linalg.cholesky(cross @ matrix.T + np.eye(len(matrix)))
        factor = np.linalg.solve(root, cross)
        return covariance - factor.T @ factor

    def look_ahead(self, depth: int, width: int, healthy: np.ndarray | None = None) -> int:
        """Return the first pair of the plan of ``depth`` injections with the least sum of
        variances, by beam search.

        Each of the best ``width`` plans is extended by the ``width`` pairs with the largest
        A-criterion; only ``healthy`` electrodes count.
        """
        beam: list[tuple[float, int | None, np.ndarray | None]] = [(0.0, None, None)]
        for steps_ahead in range(depth):
            extended: list[tuple[float, int, np.ndarray, int]] = []
            for cost, first, covariance in beam:
                predicted = self.predict_covariance(covariance, steps_ahead)
                criterion = self.design_criteria(predicted, healthy)[0]
                # A pair's cost is available before its covariance is computed.
                prior_cost = cost + self.expected_error(predicted)
                extended += [(prior_cost - criterion[pair], pair if first is None else first,
                              predicted, pair)
                             for pair in np.argsort(-criterion)[:width].tolist()]
            best = sorted(extended, key=lambda plan: plan[0])[:width]
            beam = [(cost, first, self.posterior_covariance(predicted, pair, healthy))
                    for cost, first, predicted, pair in best]
        first = beam[0][1]
        assert first is not None
        return first

    @cached_property
    def linearisation(self) -> Linearisation:
        """Linearisation of 𝓡 for the next measurement, with derivatives (L, L, s): about c_ref, or
        with a learned inflow about the prediction."""
        state = self._step(0)[2]
        coordinates = self._shared.states.coordinates(state[None])[0]
        about = self._shared.linearisation(self.filters.indices[0], coordinates)
        return about._replace(jacobian=self._by_state(state, about.jacobian))

    def relinearised_jacobian(self) -> np.ndarray:
        """Return the derivatives (L, L, s) of 𝓡 about the present estimate, in about 10 ms."""
        level = self.filters.c_ref[0]
        positive = np.maximum(self.mean, 0.1 * level)
        _, table = self.filters.table.task.observation.resistance_derivatives(positive)
        by_coordinates = level * np.tensordot(table, self._shared.states.basis, axes=(0, 0))
        return self._by_state(self._state, by_coordinates)

    def _by_state(self, state: np.ndarray, table: np.ndarray) -> np.ndarray:
        """Return derivatives (…, …, s) by the state from derivatives (…, …, q) by the
        coordinates."""
        flat = table.reshape(-1, table.shape[-1])
        by_state = self._shared.states.jacobian(state[None], flat).reshape(len(flat), -1)
        return by_state.reshape(*table.shape[:2], -1)

    @cached_property
    def _weight(self) -> np.ndarray:
        """(s, s) W: tr(W P) is the expected squared error, integrated over the scored region,
        relative to c_ref²."""
        state = self._step(0)[2]
        half = self._by_state(state, self._shared.weight[None])[0]
        return self._by_state(state, half.T[None])[0]

    @cached_property
    def _noise_variance(self) -> np.ndarray:
        """(pairs, L) noise variance of the voltages of each pair, per current squared."""
        i, j = self.rules.pairs.T
        R = self.linearisation.resistance
        voltages = self.rules.amplitude * (R[i] - R[j])
        std = self.filters.table.noise_std(voltages, self.rules.instrument.noise_floor)
        variance = np.square(std / self.rules.amplitude)
        if self.filters.faults is None:
            return variance
        return variance / np.maximum(self.filters.faults.weights(self._driven), REJECTED_WEIGHT)

    @property
    def _driven(self) -> np.ndarray:
        """(pairs, L) mask of the driven electrodes of each pair."""
        return self.rules.action_currents[:len(self.rules.pairs)] != 0.0
