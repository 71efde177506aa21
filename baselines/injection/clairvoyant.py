"""Clairvoyant: an oracle with the true faults and the true flow.

It indicates the achievable error: it simulates several plans on the episode itself and executes the
best one. The plans are greedy A-optimal among the healthy electrodes, a few fixed pairs, the best
fixed currents if actions are currents, and with a budget, injections while the true error is large.
With an unknown velocity, variances are linearised about the truth and errors weighted by their
effect in the next steps; the plans include more pairs and cycles, and it switches between plans
where that reduces the error. It is not a bound: it evaluates only some of all plans, and evaluates
them with the reduced filter.
"""

from itertools import product
from typing import Any

import numpy as np

from eitbench.bench.methods import load_method
from eitbench.data.episode_cache import cached_episode
from eitbench.envs.injection_core import InjectionCore
from eitbench.estimation.onboard.belief import Belief
from eitbench.estimation.onboard.rules import Rules

NO_INJECTION, CURRENTS = -1, -2
"""Entries of plans for no injection and for the best currents; other entries are pairs."""


class Policy:
    privileged = True
    role = "reference"
    # The cycles are for an unknown velocity; cycles of one pair are results of
    # `python studies/search_injections.py`.
    parameters: dict[str, Any] = {  # noqa: RUF012
        "fixed_pairs": [[0, 8], [0, 10]], "thresholds": [1e-4, 3e-2, 16], "intervals": [1, 2, 3],
        "horizons": [0, 2, 4, 8, 16], "changes": 10,
        "cycles": [[[7, 9]], [[7, 8]], [[8, 15]], [[9, 15]], [[1, 7]], [[6, 9]], [[1, 6]],
                   [[8, 14]], [[0, 7]], [[7, 8], [1, 7]], [[7, 8], [8, 15]],
                   [[7, 8], [1, 7], [9, 15], [0, 7]]]}

    suits = staticmethod(Belief.suits)

    def __init__(self, rules: Rules, random: np.random.Generator, core: InjectionCore) -> None:
        self.rules = rules
        self.core = core
        if rules.world.velocity_model is not None and rules.budget is None:
            self.plan = iter(self.best_switching_plan().tolist())
            return
        pairs = rules.pairs.tolist()
        every = np.ones(core.length, dtype=int)
        best = load_method("best_pair", "injection").parameters["pair"].get(rules.tuning_key)
        fixed = sorted({pairs.index(pair) for pair in [*self.parameters["fixed_pairs"], best]
                        if pair in pairs})
        if rules.budget is None:
            any_currents = load_method("best_currents", "injection")
            self.currents = np.array(any_currents.parameters["currents"], dtype=np.float32)
            options = fixed + [CURRENTS] * any_currents.suits(rules)
            errors, plans = self.rollout_plans(
                np.array([self.greedy(), *(option * every for option in options)]))
        else:
            first, last, count = self.parameters["thresholds"]
            tried = product(fixed, np.geomspace(first, last, count), self.parameters["intervals"])
            pair, threshold, interval = (np.array(part) for part in zip(*tried, strict=True))
            errors, plans = self.rollout_plans(pair[:, None] * every, threshold, interval)
        self.plan = iter(plans[errors.argmin()].tolist())

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        return self.action(next(self.plan))

    def action(self, number: int) -> Any:
        if number == CURRENTS:
            return self.currents
        return self.rules.action(None if number == NO_INJECTION else number)

    def greedy(self, horizon: int = 0) -> np.ndarray:
        """Return the pairs (steps,) of healthy electrodes with the least posterior variance, summed
        over the step and ``horizon`` later steps."""
        core = self.core
        seen = {name: array[0] for name, array in core.observe().items()}
        belief = Belief(self.rules, seen)
        covariance = None
        faults = core.faults
        if self.rules.world.velocity_model is not None:
            belief.condition_on_truth(cached_episode(self.rules.world, core.seeds[0])[core.t - 1:])
        plan = np.empty(core.length, dtype=int)
        for k in range(core.length):
            sound = (core.t + k + 1 < faults.open_circuit_from[0]) & (faults.resistance[0] == 0.0)
            predicted = belief.predict_covariance(covariance, k)
            weight = belief.future_error_weight(horizon, k) if horizon else None
            plan[k] = belief.design_criteria(predicted, sound, weight=weight)[0].argmax()
            covariance = belief.posterior_covariance(predicted, plan[k], sound)
        return plan

    def best_switching_plan(self) -> np.ndarray:
        """Return the pairs (steps,) of the best plan, which may switch at fixed intervals between
        the candidate plans."""
        pairs = self.rules.pairs.tolist()
        steps = np.arange(self.core.length)
        options = self.parameters
        cycles = [[pairs.index(pair) for pair in cycle] for cycle in options["cycles"]]
        plans = np.array([*map(self.greedy, options["horizons"]),
                          *(np.array(cycle)[steps % len(cycle)] for cycle in cycles)])
        best = plans[self.rollout_plans(plans)[0].argmin()]
        for begin in range(options["changes"], len(steps), options["changes"]):
            tried = np.concatenate([best[None], np.where(steps < begin, best, plans)])
            best = tried[self.rollout_plans(tried)[0].argmin()]
        return best

    def rollout_plans(self, plans: np.ndarray, threshold: np.ndarray | None = None,
              interval: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Roll out plans (B, steps); return mean errors (B,) and executed plans (B, steps).

        With a ``threshold`` (B,), nothing is injected while the true error is below it, or within
        the ``interval`` (B,) after the last injection.
        """
        twin = InjectionCore(self.rules, "reduced")
        plans = plans.copy()
        errors = []
        twin.reset(self.core.seeds * len(plans))
        last = np.full(len(plans), -twin.length)
        for k in range(twin.length):
            if threshold is not None:
                silent = (~(twin.errors() > threshold) | (k < last + interval)
                          | (twin.n_injections >= self.rules.budget))
                plans[silent, k] = NO_INJECTION
                last[~silent] = k
            twin.act(np.array([self.action(number) for number in plans[:, k]]))
            errors.append(twin.errors())
        return np.nanmean(errors, axis=0), plans
