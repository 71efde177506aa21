"""An episode as an animation or a single picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_rgb
from PIL import Image
from threadpoolctl import threadpool_limits

from eitbench import _check
from eitbench._files import atomic_path
from eitbench.bench.methods import Method
from eitbench.bench.run import isolated_job
from eitbench.bench.tracks import Environment
from eitbench.data.episode_cache import truth_mesh
from eitbench.envs.rendering import FIELD_COLORMAP, IDLE, SINK, SOURCE, STD_COLORMAP, draw_frame
from eitbench.report.plot import parse_single_seed, run_until, states_at


def animate(environment: str, methods: Sequence[str], seed: str, step: int | None, path: Path, *,
            every: int = 1, isolate: str = "auto") -> Path:
    """Run estimators or one policy on an episode and draw every ``every``-th scored state, or only
    state ``step``, into ``path``. Estimates of several methods are drawn below the truth.

    ``ValueError`` if a method is not compatible with the environment, several are policies, or
    the path's suffix is not .gif or .webp (.png with ``step``).
    """
    suffixes = (".gif", ".webp") if step is None else (".png",)
    if path.suffix not in suffixes:
        how = "without" if step is None else "with"
        raise ValueError(f"out must end in {' or '.join(suffixes)} {how} step, got {path.name}")
    number = parse_single_seed(seed)
    asked = Environment(environment)
    if asked.track == "injection" and len(methods) > 1:
        raise ValueError(f"policy must be one for {environment}, got {', '.join(methods)}")
    with threadpool_limits(1):
        loaded = [isolated_job(asked, method, isolate).load() for method in methods]
        env: Any = asked.make(render_mode="rgb_array")
        begin = env.core.n_initial + 1 if asked.track == "injection" else 1
        first, last = env.world.warm_up + 1, env.world.n_steps
        if step is not None:
            first = last = _check.integer("step", step, low=begin, high=last)
        at = range(first, last + 1, every)
        images = _compared_frames(env, loaded, number, at) if len(loaded) > 1 else [
            np.asarray(env.render()) for t, *_ in run_until(env, loaded[0], number, at[-1])
            if t in at]
    frames = list(map(Image.fromarray, images))
    options: dict[str, Any] = {}
    if path.suffix == ".gif":
        palette = _palette()
        frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    elif path.suffix == ".webp":
        options = {"quality": 30, "method": 6}  # a fifth of the GIF, and letters are still sharp
    if step is None:
        options |= {"save_all": True, "append_images": frames[1:], "loop": 0,
                    "duration": every * 1000 // env.metadata["render_fps"]}
    with atomic_path(path) as temporary:
        frames[0].save(temporary, path.suffix[1:], **options)
    return path


def _compared_frames(env: Any, loaded: list[Method], seed: int, at: range) -> list[np.ndarray]:
    """Return images of the truth and several estimates at these t."""
    shown = [(method.title, states_at(env, method, seed, at)) for method in loaded]
    images = []
    for t in at:
        truth, _, currents = shown[0][1][t]
        fields = [("Truth", truth_mesh(env.world), truth)]
        fields += [(title, env.task.mesh, states[t][1]) for title, states in shown]
        time = t * env.task.transport.time_step
        images.append(draw_frame(env.task, fields, currents, time))
    return images


def _palette() -> Image.Image:
    """Return the 256 colours shared by all frames: colour maps, greys, electrodes."""
    maps = [colormaps[name](np.linspace(0, 1, 110))[:, :3]
            for name in (FIELD_COLORMAP, STD_COLORMAP)]
    greys = np.linspace(0, 1, 33)[:, None].repeat(3, axis=1)
    table = np.concatenate([*maps, greys, [to_rgb(colour) for colour in (SOURCE, SINK, IDLE)]])
    image = Image.new("P", (1, 1))
    image.putpalette((255 * table).round().astype(np.uint8).tobytes())
    return image
