"""Rollouts of injection policies for bodies: `python studies/rollout.py ID`, 15 minutes.

For each of the pairs with the largest A-criterion, a rollout simulates the next voltages of bodies
that are drawn from the particles, and continues with `greedy_a` (rollout policy improvement:
Bertsekas, Tsitsiklis & Wu, J. Heuristics 3, 1997). The policy injects the pair with the smallest
sum of predicted variances of the image over these steps. All pairs have the same bodies, motions
and noise; bodies that are absent in the first step stay so. Two steps are a look-ahead of two
steps. Dev episodes, with the reduced filter.
"""

from __future__ import annotations

import argparse
from copy import copy
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from eitbench.bench.methods import load_method
from eitbench.data.seeds import parse_seeds
from eitbench.estimation.body_particles import BodyModel, BodyParticleFilter, Particles
from eitbench.estimation.onboard.policies import BeliefPolicy
from eitbench.worlds import entries
from eitbench.worlds.bodies import MovingBody

CANDIDATES = 6
BODIES = 8
STEPS = (2, 4)


class Rollout(BeliefPolicy):
    """Policy that improves `greedy_a` by rollouts of ``steps`` injections."""

    def __init__(self, rules: Any, random: np.random.Generator, steps: int) -> None:
        super().__init__(rules, random)
        self.steps = steps

    def pair(self, observation: dict[str, np.ndarray]) -> int:
        candidates = np.argsort(-self.belief.criteria()[0])[:CANDIDATES]
        pairs = np.repeat(candidates, BODIES)
        inner, random = self.belief.filters.filter, self.random
        model = inner.model
        moved, weights = model.move(inner.particles, inner.weights, random)
        drawn = random.choice(inner.n_particles, BODIES, p=weights[0])
        bodies = Particles(*(each[:, drawn] for each in moved))
        filters = inner.repeat(len(pairs))
        cost = np.zeros(len(pairs))
        for step in range(self.steps):
            if step:
                pairs = np.array([self._greedy(filters, b) for b in range(len(pairs))])
                moved, _ = model.move(bodies, np.ones((1, BODIES)), random)
                # `move` proposes more entries than there are
                bodies = moved._replace(present=moved.present & bodies.present)
            currents = self.rules.action_currents[pairs]
            voltages = simulated_voltages(model, bodies, currents, random)
            filters.assimilate(voltages, currents,
                               self.rules.instrument.measurement_mask(currents))
            cost += filters.variance(self.belief.filters.patches).sum(axis=1)
        return int(candidates[cost.reshape(CANDIDATES, BODIES).mean(axis=1).argmin()])

    def _greedy(self, filters: BodyParticleFilter, b: int) -> int:
        """Return the pair of `greedy_a` in the b-th episode of the filters."""
        belief = copy(self.belief)
        belief.filters = copy(self.belief.filters)
        belief.filters.filter = filters
        return int(belief.criteria(b)[0].argmax())


def simulated_voltages(model: BodyModel, bodies: Particles, currents: np.ndarray,
                       random: np.random.Generator) -> np.ndarray:
    """Return voltages (B, L) in V of the particles (1, `BODIES`, …) in turn, for currents (B, L);
    the noise of a particle is the same each time."""
    index, weights = (each[0] for each in model.cells(bodies))
    change = np.einsum("kbc,bc->bk", model.signals[:, index], weights)
    resistance = model.resistance + change.reshape(BODIES, *model.resistance.shape)
    by_body = np.moveaxis(currents.reshape(-1, BODIES, currents.shape[1]), 1, 0)
    voltages = by_body @ resistance
    voltages += model.noise_std(voltages) * random.standard_normal((BODIES, 1, currents.shape[1]))
    return np.moveaxis(voltages, 0, 1).reshape(currents.shape)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition(":")[0])
    parser.add_argument("env", choices=[id for id, each in entries().items()
                                        if each.track == "injection"
                                        and isinstance(each.world.target, MovingBody)
                                        and each.world.instrument.readings == "neighbours"])
    parser.add_argument("--seeds", default="dev:0-15")
    given = parser.parse_args()
    env: Any = gym.make(given.env, observation="raw")
    policies = {"greedy_a": load_method("greedy_a", "injection").make} | {
        f"rollout, {steps} steps": partial(Rollout, steps=steps) for steps in STEPS}
    rows = []
    for seed in tqdm(parse_seeds(given.seeds), unit="episode", disable=None):
        row = {}
        for name, make in policies.items():
            observation, _ = env.reset(seed=seed)
            policy = make(env.unwrapped.rules, np.random.default_rng(seed))
            errors, done = [], False
            while not done:
                observation, _, done, _, info = env.step(policy.act(observation))
                errors += [info["error"]] if "error" in info else []
            row[name] = 1e4 * np.mean(errors)
        rows.append(row)
    table = pd.DataFrame(rows)
    difference = table.sub(table["greedy_a"], axis=0)
    print(pd.DataFrame({
        "10⁴ ẽ_c": table.mean(), "difference": difference.mean(),
        "± 95 %": 1.96 * difference.std() / len(table)**0.5}).round(2).to_string())


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
