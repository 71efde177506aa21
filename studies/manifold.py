"""One instrument for several pipes: `python studies/manifold.py`, some minutes.

N pipes with rare slugs share an instrument that injects into one of them in each step, through a
pair at the inlet; each pipe has its own reduced filter with a learned inflow. The table has the
mean error of all pipes relative to injections in turn, for policies that see the filters, and for
one that has the true errors.

The Whittle index of a pipe is the price of an injection at which injecting now and one step later
have the same mean cost in the long run; the cost is the expected squared error of the filter.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from eitbench.data.seeds import parse_seeds
from eitbench.envs.injection_core import InjectionCore
from eitbench.estimation.onboard.reduced_filters import ReducedFilters
from eitbench.estimation.onboard.rules import Rules
from eitbench.worlds import entry

ID = "eitbench/Pipe2DInjectionInflowBudget-v0"
SEEDS = "train:0-31"
PAIR = [0, 10]
"""Best pair of these pipes with a budget."""
PIPES = (2, 4, 8)
ALARMS = (1.0, 1.5, 2.5)
"""RMS of innovations in predicted standard deviations that indicate a slug."""
BONUSES = (2.0, 4.0)
"""Steps by which a pipe with a slug is preferred."""
SLUG_VARIANCE, PRIOR, PERSISTENCE = 9.0, 0.2, 0.8
"""Variance of innovations in a slug relative to the predicted one, probability of a slug in a pipe
without information, and the part of the deviation from it that remains after a step."""
POLICIES = ["largest variance", "largest gain", "Whittle index",
            *(f"Whittle index, slug {bonus}" for bonus in BONUSES),
            *(f"age, alarm {alarm} and {bonus}" for alarm in ALARMS for bonus in BONUSES),
            "true error *"]


def predicted(filters: ReducedFilters, currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the expected squared errors (B,) of the next states, and their reduction by an
    injection of ``currents`` (L,) in A/m."""
    shared, states = filters.shared, filters.shared.single
    mean, covariance = states.propagate(filters.filter.mean, filters.filter.covariance)
    B, q = states.coordinates(mean).shape
    W = shared.weight.astype(np.float32)
    J = states.jacobian(mean, np.broadcast_to(np.eye(q, dtype=np.float32), (B, q, q)))
    level = filters.c_ref**2
    total = ((J @ covariance) * (W @ J)).sum(axis=(1, 2))
    repeated = np.tile(currents, (B, 1))
    voltages, matrix, _ = shared.linearise(filters.indices, states.coordinates(mean), repeated)
    std = filters.table.noise_std(voltages, 0.0)[..., None].astype(np.float32)
    H = states.jacobian(mean, matrix / std)
    S = H @ covariance @ H.swapaxes(1, 2) + np.eye(H.shape[1], dtype=np.float32)
    cross = H @ covariance @ J.swapaxes(1, 2)
    gain = (np.linalg.inv(S) * (cross @ W @ cross.swapaxes(1, 2))).sum(axis=(1, 2))
    return total * level, gain * level


def errors(rules: Rules, n_pipes: int, policy: str) -> np.ndarray:
    """Return the mean error (groups,) of the pipes of each instrument."""
    seeds = parse_seeds(SEEDS)
    core = InjectionCore(rules, "reduced")
    core.reset(seeds)
    pair = rules.pairs.tolist().index(PAIR)
    first = np.arange(0, len(seeds), n_pipes)
    age, surprise, cost, steps = np.zeros((4, len(seeds)))
    slug = np.full(len(seeds), PRIOR)
    scored = []
    for k in range(core.length):
        if policy == "turn":
            index = np.arange(len(seeds)) % n_pipes == k % n_pipes
        elif policy == "true error *":
            index = np.nan_to_num(core.errors()) + 1e-9 * age
        elif policy.startswith("age"):
            alarm, bonus = (float(policy.split()[i]) for i in (2, 4))
            index = age + bonus * (surprise > alarm)
        else:
            total, gain = predicted(core.filters, rules.action_currents[pair])
            index = gain if "gain" in policy else total
        if policy.startswith("Whittle"):
            index = steps * total - cost
            if "slug" in policy:
                index = index * (1.0 + float(policy.split()[-1]) * slug)
            index = index + 1e-9 * age
        chosen = first + np.asarray(index, dtype=float).reshape(-1, n_pipes).argmax(axis=1)
        actions = np.full(len(seeds), len(rules.pairs))                        # no injection
        actions[chosen] = pair
        core.act(actions)
        age += 1.0
        age[chosen] = 0.0
        innovations = core.filters.features()["innovations"][chosen]
        surprise[chosen] = np.sqrt((innovations**2).mean(axis=1))
        slug = PRIOR + PERSISTENCE * (slug - PRIOR)
        ratio = surprise[chosen]**2 * (1.0 - 1.0 / SLUG_VARIANCE) - np.log(SLUG_VARIANCE)
        odds = slug[chosen] / (1.0 - slug[chosen]) * np.exp(0.5 * np.clip(ratio, -10.0, 10.0))
        slug[chosen] = odds / (1.0 + odds)
        if policy.startswith("Whittle"):
            cost, steps = cost + total, steps + 1.0
            cost[chosen], steps[chosen] = (total - gain)[chosen], 1.0
        scored.append(core.errors())
    return np.nanmean(scored, axis=0).reshape(-1, n_pipes).mean(axis=1)


def main() -> None:
    world = entry(ID).world
    steps = world.n_steps - len(world.currents)
    rules = Rules(replace(world, schedule=replace(world.schedule, budget=steps)), inflow="learned")
    turn = {n_pipes: errors(rules, n_pipes, "turn") for n_pipes in PIPES}
    print("| policy | " + " | ".join(f"{n} pipes" for n in PIPES) + " |\n|---|"
          + "---:|" * len(PIPES))
    print("| in turn, error | " + " | ".join(f"{turn[n].mean():.5f}" for n in PIPES) + " |")
    for policy in POLICIES:
        cells = []
        for n_pipes in PIPES:
            found = errors(rules, n_pipes, policy)
            draws = np.random.default_rng(0).integers(len(found), size=(1000, len(found)))
            ratios = found[draws].mean(axis=1) / turn[n_pipes][draws].mean(axis=1)
            low, high = np.quantile(ratios, (0.025, 0.975))
            cells.append(f"{found.mean() / turn[n_pipes].mean():.2f} ({low:.2f} to {high:.2f})")
        print(f"| {policy} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
