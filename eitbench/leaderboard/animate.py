"""An episode as an animation or a single picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from eitbench import _check
from eitbench.leaderboard.baselines import load_baseline
from eitbench.leaderboard.run import Environment, board_of, play
from eitbench.seeds import parse_seeds


def animate(environment: str, baseline: str, seed: str, step: int | None, path: Path) -> Path:
    """Play ``baseline`` on one episode and draw its scored states, or only state ``step``, into ``path``.

    Raises
    ------
    ValueError
        If the baseline cannot play the environment, or the path's suffix is not .gif (.png with ``step``).
    """
    suffix = ".gif" if step is None else ".png"
    if path.suffix != suffix:
        raise ValueError(f"out must end in {suffix} {'without' if step is None else 'with'} step, got {path.name}")
    seeds = parse_seeds(seed)
    if len(seeds) != 1:
        raise ValueError(f"seed must name one episode, got {seed!r}")
    loaded, env = load_baseline(baseline), Environment(environment).make(render_mode="rgb_array")
    if board_of(env) not in loaded.boards:
        raise ValueError(f"baseline {loaded.name} plays {', '.join(loaded.boards)}, but {environment} is a "
                         f"{board_of(env)} environment")
    first, last = env.task.warm_up + 1, env.task.n_steps
    if step is not None:
        first = last = _check.integer("step", step, low=1, high=env.task.n_steps)
    frames = []
    with threadpool_limits(1):
        for t, _ in tqdm(play(env, loaded, seeds[0]), total=env.task.n_steps, desc="drawing", unit="state",
                         disable=None):
            if first <= t <= last:
                frames.append(Image.fromarray(np.asarray(env.render())))
            if t == last:
                break
    path.parent.mkdir(parents=True, exist_ok=True)
    # One palette for all frames keeps colours steady and the file small.
    palette = frames[len(frames) // 2].quantize(255)
    if step is None:
        small = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
        small[0].save(path, save_all=True, append_images=small[1:], duration=1000 // env.metadata["render_fps"], loop=0)
    else:
        frames[0].save(path)
    return path
