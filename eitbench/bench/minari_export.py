"""Export the episodes of a policy as a Minari data set."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from tqdm import tqdm

from eitbench import __version__
from eitbench._extras import require_extra
from eitbench.bench.methods import Method, load_method
from eitbench.bench.runner import policy_generator
from eitbench.bench.tracks import check_track
from eitbench.data.dataset import resolve_seeds
from eitbench.data.export import WARNING
from eitbench.data.presimulation import presimulate
from eitbench.data.seeds import allow_test_seeds, format_seed, is_test, seed_ranges
from eitbench.worlds.registry import published_returns

if TYPE_CHECKING:
    from minari.data_collector import EpisodeBuffer

N_EPISODES = 32
"""Number of episodes of a published return."""
DESCRIPTION = """\
{env}: process tomography in which an agent chooses every injection. Policy {policy}: {title}. \
Episodes {seeds}; the metadata of an episode holds its seed, with which the actions reproduce \
observations and rewards. Observations are scaled as documented in \
eitbench.envs.injection_core.flatten_scaled; a reward is the relative squared error of the best \
constant estimate minus the relative squared error of the estimate, and zero in states that are \
not scored. \
Simulated by eitbench {version}; no measured data, no personal data. Licence: MIT. {warning}"""


def export_minari(name: str, env: str, policy: str, seeds: str | Sequence[int], *,
                  n_jobs: int = 1, backend: str = "loky") -> int:
    """Run a policy, write its episodes at the end to Minari's data folder, and return their number.

    ``name`` is the name of the data set, e.g. ``eitbench/pipe2d/random-pair-v0``; ``env`` the id of
    an injection environment; ``policy`` a built-in name, or the path of a file, which runs in this
    process; ``seeds`` as in `eitbench.dataset`, ``n_jobs`` and ``backend`` as in
    `eitbench.data.presimulation.presimulate`. ``ValueError`` for an unknown environment, policy or
    seed, an incompatible policy, or a malformed or existing name.
    """
    with require_extra("format minari"):
        from minari import create_dataset_from_buffers
        from minari.dataset.minari_dataset import parse_dataset_id
        from minari.storage.datasets_root_dir import get_dataset_path
    try:
        parse_dataset_id(name)
    except ValueError:
        raise ValueError("out must be the name of a Minari data set, such as "
                         f"eitbench/pipe2d/random-pair-v0; got {name!r}") from None
    if get_dataset_path(name).exists():
        raise ValueError(f"out must be the name of a new data set; there is {name!r}, which "
                         f"`minari delete {name}` removes")
    check_track(env, "injection")
    numbers = resolve_seeds(seeds)
    method = load_method(policy, "injection")
    made = gym.make(env)
    inner: Any = made.unwrapped
    if not method.suits(inner.rules):
        raise ValueError(f"policy must suit env, got {policy!r}, which does not")
    presimulate(inner.world, numbers, n_jobs=n_jobs, backend=backend)
    episodes = [_run(made, method, seed, k) for k, seed in enumerate(
        tqdm(numbers, desc="running", unit="episode", disable=None))]
    description = DESCRIPTION.format(
        env=env, policy=method.name, title=method.title, version=__version__,
        seeds=seed_ranges(map(format_seed, numbers)),
        warning=WARNING if any(map(is_test, numbers)) else "").strip()
    returns = {row["group"]: float(row["mean"]) for row in published_returns(env)}
    # the id: the spec of an environment that was made has an episode limit, which would truncate
    create_dataset_from_buffers(name, episodes, env=env, eval_env=env, algorithm_name=method.name,
                                author="The eitbench authors", requirements=["eitbench"],
                                ref_min_score=returns.get("random"),
                                ref_max_score=max(returns.values(), default=None),
                                num_episodes_average_score=N_EPISODES, description=description)
    return len(episodes)


def _run(env: gym.Env[Any, Any], policy: Method, seed: int, number: int) -> EpisodeBuffer:
    """Run one episode."""
    from minari.data_collector import EpisodeBuffer
    inner: Any = env.unwrapped
    with allow_test_seeds():
        observations = [env.reset(seed=seed)[0]]
    player = policy.make(inner.rules, policy_generator(seed), *[inner.core] * policy.privileged)
    steps: list[tuple[Any, ...]] = []
    while not steps or not any(steps[-1][2:]):                  # terminated or truncated
        raw = {name: array[0] for name, array in inner.core.observe().items()}
        action = player.act(raw)
        observation, *rest, _ = env.step(action)
        observations.append(observation)
        steps.append((action, *rest))
    columns = map(np.array, zip(*steps, strict=True))  # in the buffer's order
    return EpisodeBuffer(number, seed, None, np.array(observations), *columns, infos={})
