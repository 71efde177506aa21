"""An episode as an animation or a single picture."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_rgb
from PIL import Image
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from eitbench import _check
from eitbench.bench.isolation import choose_isolation
from eitbench.bench.methods import Method
from eitbench.bench.playing import estimates, injections
from eitbench.bench.run import Job
from eitbench.bench.tracks import Environment, board_of
from eitbench.data.seeds import parse_seeds
from eitbench.envs.injection import InjectionEnv
from eitbench.envs.rendering import (
    FIELD_MAP,
    IDLE,
    SINK,
    SOURCE,
    SPREAD_MAP,
    draw_comparison,
)

MOVING = (".gif", ".webp")
"""Suffixes of animations."""


def animate(environment: str, methods: Sequence[str], seed: str, step: int | None, path: Path, *,
            every: int = 1, isolate: str = "auto") -> Path:
    """Play a baseline, or a policy, on one episode and draw its scored states into ``path``, one in
    ``every``, or only state ``step``. Of several baselines the estimates are drawn below the truth.

    ``ValueError`` if a method cannot play the environment, several are policies, or the path's
    suffix is not .gif or .webp (.png with ``step``).
    """
    suffixes = MOVING if step is None else (".png",)
    if path.suffix not in suffixes:
        how = "without" if step is None else "with"
        raise ValueError(f"out must end in {' or '.join(suffixes)} {how} step, got {path.name}")
    seeds = parse_seeds(seed)
    if len(seeds) != 1:
        raise ValueError(f"seed must name one episode, got {seed!r}")
    played = Environment(environment)
    if played.track == "injection" and len(methods) > 1:
        raise ValueError(f"policy must be one for {environment}, got {', '.join(methods)}")
    with threadpool_limits(1):
        kinds = [choose_isolation(played, method, isolate) for method in methods]
        loaded = [Job(played, method, seeds[0], kind).load()
                  for method, kind in zip(methods, kinds, strict=True)]
        env: Any = played.make(render_mode="rgb_array")
        for each in loaded:
            if board_of(env) not in each.boards:
                raise ValueError(f"baseline {each.name} plays {', '.join(each.boards)}, but "
                                 f"{environment} is a {board_of(env)} environment")
        begin = env.core.first + 1 if played.track == "injection" else 1
        first, last = env.world.warm_up + 1, env.world.n_steps
        if step is not None:
            first = last = _check.integer("step", step, low=begin, high=last)
        draw = _drawn if len(loaded) == 1 else _compared
        frames = [Image.fromarray(frame)
                  for frame in draw(env, loaded, seeds[0], range(first, last + 1, every))]
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


def _drawn(env: Any, loaded: list[Method], seed: int, at: range) -> Iterator[np.ndarray]:
    """What the environment draws of one method at these t."""
    played: Any = injections if isinstance(env, InjectionEnv) else estimates
    for t, *_ in _until(at, played(env, loaded[0], seed)):
        if t in at:
            yield np.asarray(env.render())


def _compared(env: Any, loaded: list[Method], seed: int, at: range) -> Iterator[np.ndarray]:
    """Truth and the estimates of several baselines at these t."""
    shown: list[tuple[str, dict[int, np.ndarray]]] = []
    for method in loaded:
        shown.append((method.title, {t: estimate.mean for t, estimate in
                                     _until(at, estimates(env, method, seed)) if t in at}))
    truth = env.truth()
    task = env.task
    for t in at:
        fields = [("Truth", env.truth_mesh(), truth[t - 1])]
        fields += [(title, task.mesh, means[t]) for title, means in shown]
        yield draw_comparison(task, fields, task.currents[(t - 1) % len(task.currents)],
                              t * task.transport.time_step)


def _until(at: range, states: Iterator[Any]) -> Iterator[Any]:
    """The states up to the last that is asked for."""
    for state in tqdm(states, total=at[-1], desc="playing", unit="state", disable=None):
        yield state
        if state[0] == at[-1]:
            break


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
