"""What an injection policy may believe: the filter inside the environment, followed from outside in
reduced order."""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np

from eitbench.estimation.design import pair_design_criteria
from eitbench.estimation.onboard.levels import levels_of
from eitbench.estimation.onboard.reduced_filters import ReducedFilters

if TYPE_CHECKING:
    from eitbench.estimation.onboard.levels import Linearisation
    from eitbench.estimation.onboard.rules import Rules

DOUBTFUL = 0.3
"""`Belief.doubt` from which on an electrode is taken for broken."""
FORGIVEN = 0.8
"""Part of the doubt after failed injections that is left one step on, if the electrode does not
drive."""


class Belief:
    """The covariance of what the environment's filter knows, and what each injection would teach
    it.

    It is made at the first observation of an episode and is shown every later one; all from raw
    observations. The state is reduced (120 coordinates), in parts of the level, with the mass
    matrix as the identity: the trace of its covariance is the expected squared error, integrated.
    Where the flow is estimated too, the mean velocity (m/s) is the state's last entry; s counts all
    of them.

    Parameters
    ----------
    rules : Rules
        Of the environment.
    observation : dict
        The first one.
    """

    def __init__(self, rules: Rules, observation: dict[str, np.ndarray]) -> None:
        self.rules = rules
        self._filters = ReducedFilters(rules, observation["frame"][None])
        self._along: np.ndarray | None = None
        self._forget()
        reading, self._driving = observation["doubt"]
        self.doubt = reading + self._driving
        """(L,) share of an electrode's recent readings, and of the recent injections it drove, not
        believed; summed."""

    @classmethod
    def beforehand(cls, rules: Rules) -> Belief:
        """Before any episode: as if a first frame without fault or noise had been measured in the
        expected liquid."""
        frame = rules.world.currents @ levels_of(rules.world).linearised(0).resistance
        return cls(rules, {"frame": frame, "doubt": np.zeros((2, frame.shape[1]))})

    @classmethod
    def follow(cls, belief: Belief | None, rules: Rules,
               observation: dict[str, np.ndarray]) -> Belief:
        """One more observation: the first of an episode makes a belief, which is then shown the
        others."""
        if belief is None:
            return cls(rules, observation)
        belief.see(observation)
        return belief

    def see(self, observation: dict[str, np.ndarray]) -> None:
        """Take in the outcome of the last injection.

        A failed injection does not say which of its two electrodes is broken. Both are doubted and,
        if left alone, forgiven: whichever then reads what was predicted is trusted again, and a
        broken one reads interference.
        """
        self._filters.assimilate(observation["voltages"][None], observation["currents"][None])
        self._along = None
        self._forget()
        reading, driving = observation["doubt"]
        self._driving = np.where(observation["currents"] == 0.0, FORGIVEN * self._driving, driving)
        self.doubt = reading + self._driving

    def told(self, entries: np.ndarray) -> None:
        """Be shown the truth, by the rest of an episode's recording from the present t on: for
        bounds only."""
        self._along = self._filters.truth(entries)
        self._forget()

    def _forget(self) -> None:
        """Drop what was computed for the last state."""
        self._steps: list[tuple[np.ndarray, ...]] = []
        vars(self).pop("linearised", None)
        vars(self).pop("_weight", None)

    @property
    def mean(self) -> np.ndarray:
        """(n,) estimate in mol/m³ at the nodes of the task's mesh."""
        return self._filters.means()[0]

    @property
    def sound(self) -> np.ndarray:
        """(L,) bool; electrodes that recent readings and injections give no reason to doubt."""
        return np.asarray(self.doubt < DOUBTFUL)

    @property
    def least_doubtful(self) -> int:
        """The pair to inject where too few electrodes are sound."""
        return int(self.doubt[self.rules.pairs].sum(axis=1).argmin())

    def predicted(self, covariance: np.ndarray | None = None, ahead: int = 0) -> np.ndarray:
        """(s, s) covariance one step on, before its measurement; from the present one or another.

        ``ahead`` says how many steps from now that other one holds; it matters where the flow is
        estimated, since what an error of the velocity does depends on what flows.
        """
        transition, noise, _ = self._step(ahead)
        now = self._filters.covariance if covariance is None else covariance
        return transition @ now @ transition.T + noise

    def _step(self, ahead: int) -> tuple[np.ndarray, ...]:
        """Return the derivative of the step that begins ``ahead`` steps from now, the covariance of
        its noise, and the mean after it."""
        if ahead >= len(self._steps):
            count = max(ahead + 1, 2 * len(self._steps))
            if self._along is not None:
                count = len(self._along)
            self._steps = self._filters.steps(count, self._along)
        return self._steps[ahead]

    def expected_error(self, covariance: np.ndarray) -> float:
        """Expected squared error, integrated over what counts, in parts of the level's square."""
        return float((self._weight * covariance).sum())

    def foresight(self, steps: int, ahead: int = 0) -> np.ndarray:
        """(s, s) weight of errors at the next measurement (the first after ``ahead`` more steps) by
        all that they will do: the flow carries them, and the squared errors over what counts are
        summed over this and so many steps more.
        """
        weight = total = self._weight
        # The states of an episode are one more than the steps between them.
        last = len(self._along) - 1 if self._along is not None else ahead + steps + 1
        for k in range(min(ahead + steps, last - 1), ahead, -1):
            transition = self._step(k)[0]
            total = weight + transition.T @ total @ transition
        return total

    def gains(self, covariance: np.ndarray, sound: np.ndarray | None = None,
              derivative: np.ndarray | None = None,
              weight: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """What each pair would teach about a state with this covariance: `pair_design_criteria`,
        (pairs,) each.

        Of electrodes that are not ``sound`` no reading counts, and pairs with one of them teach
        nothing. ``derivative`` is that about the level, or another, such as `relinearised`.
        ``weight`` is that of present errors over what counts, or another, such as `foresight`.
        """
        L = self.rules.pairs.max() + 1
        D = (self.derivative if derivative is None else derivative).reshape(L * L, -1)
        DP = D @ covariance
        variance = self._noise_variance
        if sound is not None:
            variance = np.where(sound, variance, np.inf)
        weight = self._weight if weight is None else weight
        tables = ((DP @ D.T).reshape(L, L, L, L), (DP @ weight @ DP.T).reshape(L, L, L, L))
        gains = pair_design_criteria(*tables, self.rules.pairs, variance)
        if sound is not None:
            usable = sound[self.rules.pairs].all(axis=1)
            gains = gains[0] * usable, gains[1] * usable
        return gains

    def after(self, covariance: np.ndarray, pair: int,
              sound: np.ndarray | None = None) -> np.ndarray:
        """(s, s) covariance once this pair has been injected into a state with ``covariance``."""
        i, j = self.rules.pairs[pair]
        variance = self._noise_variance[pair]
        matrix = (self.derivative[i] - self.derivative[j]) / np.sqrt(variance)[:, None]
        if sound is not None:
            if not sound[[i, j]].all():
                return covariance
            matrix = matrix[sound]
        cross = matrix @ covariance
        root = np.linalg.cholesky(cross @ matrix.T + np.eye(len(matrix)))
        learnt = np.linalg.solve(root, cross)
        return covariance - learnt.T @ learnt

    def look_ahead(self, depth: int, width: int, sound: np.ndarray | None = None) -> int:
        """First pair of the plan of ``depth`` injections with the least sum of variances, by beam
        search.

        Each of the best ``width`` plans grows by the ``width`` pairs that teach most; only
        ``sound`` electrodes count.
        """
        beam: list[tuple[float, int | None, np.ndarray | None]] = [(0.0, None, None)]
        for ahead in range(depth):
            grown: list[tuple[float, int, np.ndarray, int]] = []
            for cost, first, covariance in beam:
                predicted = self.predicted(covariance, ahead)
                gains = self.gains(predicted, sound)[0]
                # A pair's cost is known before its covariance is computed.
                before = cost + self.expected_error(predicted)
                grown += [(before - gains[pair], pair if first is None else first, predicted, pair)
                          for pair in np.argsort(-gains)[:width].tolist()]
            best = sorted(grown, key=lambda leaf: leaf[0])[:width]
            beam = [(cost, first, self.after(predicted, pair, sound))
                    for cost, first, predicted, pair in best]
        first = beam[0][1]
        assert first is not None
        return first

    @cached_property
    def linearised(self) -> Linearisation:
        """Linearisation of 𝓡 that the filter uses for the next measurement: about the level, or
        with a learned inflow about the prediction."""
        return self._filters.linearised(self._step(0)[2])

    @property
    def derivative(self) -> np.ndarray:
        """(L, L, s) derivatives of `linearised`."""
        return self.linearised.derivative

    def relinearised(self) -> np.ndarray:
        """(L, L, s) derivatives of 𝓡 by the state, about the present estimate; some 10 ms."""
        return self._filters.relinearised()

    @cached_property
    def _weight(self) -> np.ndarray:
        return self._filters.weight(self._step(0)[2])

    @property
    def _noise_variance(self) -> np.ndarray:
        return _noise_variance(self.rules, self.linearised.resistance.tobytes())


@lru_cache(maxsize=64)
def _noise_variance(rules: Rules, resistance: bytes) -> np.ndarray:
    """(pairs, L) of the voltages of each pair, per current squared."""
    i, j = rules.pairs.T
    R = np.frombuffer(resistance).reshape(rules.pairs.max() + 1, -1)
    levels = levels_of(rules.world)
    std = [levels.noise_std(rules.amplitude * column, rules.instrument.noise_floor)
           for column in R[i] - R[j]]
    return (np.array(std) / rules.amplitude)**2
