"""An episode as an animation or a single picture."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_rgb
from PIL import Image
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from eitbench import _check
from eitbench.bench.playing import estimates, injections
from eitbench.bench.run import Job
from eitbench.bench.suites import is_isolated
from eitbench.bench.tracks import Environment, board_of
from eitbench.data.seeds import parse_seeds
from eitbench.envs.rendering import FIELD_MAP, IDLE, SINK, SOURCE, SPREAD_MAP

MOVING = (".gif", ".webp")
"""Suffixes of animations."""


def animate(environment: str, method: str, seed: str, step: int | None, path: Path, *,
            every: int = 1, isolate: str = "others") -> Path:
    """Play a baseline, or a policy, on one episode and draw its scored states into ``path``, one in
    ``every``, or only state ``step``.

    ``ValueError`` if the method cannot play the environment, or the path's suffix is not .gif or
    .webp (.png with ``step``).
    """
    suffixes = MOVING if step is None else (".png",)
    if path.suffix not in suffixes:
        how = "without" if step is None else "with"
        raise ValueError(f"out must end in {' or '.join(suffixes)} {how} step, got {path.name}")
    seeds = parse_seeds(seed)
    if len(seeds) != 1:
        raise ValueError(f"seed must name one episode, got {seed!r}")
    played = Environment(environment)
    with threadpool_limits(1):
        loaded: Any = Job(played, method, seeds[0], is_isolated(played, method, isolate)).load()
        env: Any = played.make(render_mode="rgb_array")
        states: Iterator[tuple[Any, ...]]
        if played.track == "injection":
            begin = env.core.first + 1
            states = injections(env, loaded, seeds[0])
        else:
            if board_of(env) not in loaded.boards:
                raise ValueError(f"baseline {loaded.name} plays {', '.join(loaded.boards)}, but "
                                 f"{environment} is a {board_of(env)} environment")
            begin = 1
            states = estimates(env, loaded, seeds[0])
        first, last = env.world.warm_up + 1, env.world.n_steps
        if step is not None:
            first = last = _check.integer("step", step, low=begin, high=last)
        frames = []
        for t, *_ in tqdm(states, total=last, desc="drawing", unit="state", disable=None):
            if first <= t <= last and (t - first) % every == 0:
                frames.append(Image.fromarray(np.asarray(env.render())))
            if t == last:
                break
    path.parent.mkdir(parents=True, exist_ok=True)
    options: dict[str, Any] = {}
    if path.suffix == ".gif":
        palette = _palette()
        frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    elif path.suffix == ".webp":
        options = {"quality": 30, "method": 6}  # a fifth of the GIF, and letters are still sharp
    if step is None:
        options |= {"save_all": True, "append_images": frames[1:], "loop": 0,
                    "duration": every * 1000 // env.metadata["render_fps"]}
    frames[0].save(path, **options)
    return path


def _palette() -> Image.Image:
    """The 256 colours of all frames, which keeps them steady: colour maps, greys, electrodes."""
    colours = [colormaps[name](np.linspace(0, 1, n))[:, :3]
               for name, n in ((FIELD_MAP, 120), (SPREAD_MAP, 100))]
    greys = np.linspace(0, 1, 27)[:, None].repeat(3, axis=1)
    pairs = [to_rgb(colour) for colour in (SOURCE, SINK, IDLE)]
    halves = [tuple(0.5 + 0.5 * c for c in colour) for colour in pairs]  # at the edges of the bars
    table = np.concatenate([*colours, greys, pairs, halves, halves])[:256]
    image = Image.new("P", (1, 1))
    image.putpalette((255 * table).round().astype(np.uint8).tobytes())
    return image
