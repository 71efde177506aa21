"""An episode as an animation or a single picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_rgb
from PIL import Image
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from eitbench import _check
from eitbench.envs.rendering import FIELD_MAP, IDLE, SINK, SOURCE, SPREAD_MAP
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
    if step is None:
        save_animation(frames, path, env.metadata["render_fps"])
    else:
        path.parent.mkdir(parents=True, exist_ok=True)
        frames[0].save(path)
    return path


def save_animation(frames: list[Image.Image], path: Path, frames_per_second: int) -> None:
    """Write frames of an environment as a GIF, and its folder if need be."""
    palette = _palette()
    small = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    path.parent.mkdir(parents=True, exist_ok=True)
    small[0].save(path, save_all=True, append_images=small[1:], duration=1000 // frames_per_second, loop=0)


def _palette() -> Image.Image:
    """The 256 colours of a frame: both colour maps, greys, and the electrodes; one for all frames keeps them steady."""
    colours = [colormaps[name](np.linspace(0, 1, n))[:, :3] for name, n in ((FIELD_MAP, 120), (SPREAD_MAP, 100))]
    greys = np.linspace(0, 1, 27)[:, None].repeat(3, axis=1)
    pairs = [to_rgb(colour) for colour in (SOURCE, SINK, IDLE)]
    halves = [tuple(0.5 + 0.5 * c for c in colour) for colour in pairs]              # at the edges of the bars
    table = np.concatenate([*colours, greys, pairs, halves, halves])[:256]
    image = Image.new("P", (1, 1))
    image.putpalette((255 * table).round().astype(np.uint8).tobytes())
    return image
