"""Errors of policies while they track a body: `python studies/body_errors.py ID POLICY …`.

Prints ẽ_c, on dev:0-31 with the reduced filter, and the parts that arise in the first five steps
after a body enters and later, with the position within 5 mm, within 40 mm, or farther away. The
last line is the error of the image with the true position and area, a disc that the filter
interpolates on a coarse mesh.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from eitbench.bench.methods import load_method
from eitbench.bench.tracks import Environment
from eitbench.data.seeds import parse_seeds
from eitbench.envs.injection_core import InjectionCore
from eitbench.worlds.random_streams import episode_streams

SEEDS = "dev:0-31"
NEW_STEPS = 5
PARTS = ("no body", f"first {NEW_STEPS} steps", "later, within 5 mm", "within 40 mm", "farther")
LIMITS = (5e-3, 40e-3)
"""m, of the distance between the estimated and the true position."""


def parts_of_error(env: Any, policy: str) -> np.ndarray:
    """Return the mean error, as a sum over the parts (parts,)."""
    method = load_method(policy, "injection")
    core, sums, count = env.core, np.zeros(len(PARTS)), 0
    for seed in parse_seeds(SEEDS):
        observation, _ = env.reset(seed=seed)
        body = path_of(core)
        acting = method.make(env.rules, np.random.default_rng(0), *[core] * method.privileged)
        for t in range(core.t + 1, core.world.n_steps + 1):
            observation, *_ = env.step(acting.act(observation))
            if t <= core.world.warm_up:
                continue
            distance = np.linalg.norm(core.filters.bodies()[0, 0, :2] - body.centres[t])
            is_new = not body.present[max(t - NEW_STEPS, 0):t + 1].all()
            part = (0 if not body.present[t] else
                    1 if is_new else 2 + int(np.searchsorted(LIMITS, distance)))
            sums[part] += core.errors()[0]
            count += 1
    return sums / count


def image_error(env: Any) -> float:
    """Return the mean error of images with the true position and area."""
    core, errors = env.core, []
    for seed in parse_seeds(SEEDS):
        env.reset(seed=seed)
        body = path_of(core)
        filters = core.filters.filter
        core.load_until(core.world.n_steps)
        for t in range(core.world.warm_up + 1, core.world.n_steps + 1):
            for values, true in zip(filters.particles, (
                    body.centres[t], 0.0, (body.radius / filters.model.radius)**2,
                    body.present[t]), strict=True):
                values[:] = true
            filters._density, core._errors, core.t = None, None, t
            errors.append(core.errors()[0])
    return float(np.mean(errors))


def path_of(core: InjectionCore) -> Any:
    """Return the path of the body in the first episode of a core."""
    return core.world.target.path(core.world, episode_streams(core.seeds[0]).flow)


def main() -> None:
    parser = argparse.ArgumentParser(description="Errors of policies while they track a body.")
    parser.add_argument("env", help="id of an environment with a moving body")
    parser.add_argument("policy", nargs="+", help="name or path")
    arguments = parser.parse_args()
    env = Environment(arguments.env, "{}").make(estimator="reduced", observation="raw").unwrapped
    for policy in arguments.policy:
        parts = parts_of_error(env, policy)
        each = ", ".join(f"{name} {part:.5f}" for name, part in zip(PARTS, parts, strict=True))
        print(f"{policy}: ẽ_c {parts.sum():.5f} = {each}", flush=True)
    print(f"true position and area: ẽ_c {image_error(env):.5f}")


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
