"""Compose the page of an environment: its description, class docstring, and parameters."""

from __future__ import annotations

import ast
import inspect
import textwrap
from dataclasses import fields, is_dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import gymnasium as gym
from gymnasium import spaces

from eitbench.estimation.onboard.episode_filters import BODY
from eitbench.worlds.registry import entry, published_returns
from eitbench.worlds.world import World

KEY_DESCRIPTIONS = {
    "voltages": "measured electrode potentials relative to their mean, V, with noise",
    "currents": "injected currents, A (in 2D A per metre of depth), summing to zero",
    "recent": "currents of the last four steps, or of the last four injections, the latest first",
    "frame": "voltages of the first frame; not in the scaled observation",
    "innovations": "measured minus predicted voltages of the last step, or of the last injection, "
                   "in predicted standard deviations",
    "mean": "estimate on {columns} × {rows} patches, x first, mol/m³",
    "std": "standard deviation of the estimate, mol/m³",
    "doubt": "fault score: recent fraction of an electrode's measurements that the gate rejected, "
             "and of injections through the electrode; if faults are estimated, probabilities of a "
             "broken wire and of a bad contact",
    "velocity": "estimated mean velocity, m/s",
    "velocity_std": "standard deviation of the velocity, m/s",
    "body": f"estimate of each body, given that it is present: {'; '.join(BODY)}",
    "gains": "A-criterion of each pair relative to the largest one",
    "waited": "steps since the last injection",
    "left": "remaining steps and, with a budget, remaining injections",
}
"""Meaning of each entry of an observation."""

WORLD_TEXT = "[T] marks numbers from the thesis, [E] choices of eitbench."
RETURNS_TEXT = """
Mean sum of rewards in the episodes dev:0–31 with the reduced filter, ± half of its 95 % interval,
of the best built-in policy of each group. `spec.reward_threshold` is the largest return without
training. Made by `python studies/returns.py`.
"""


def describe_environment(id: str) -> str:
    """Compose the page of a registered id as Markdown; ``ValueError`` if the id is unknown."""
    registered = entry(id)
    env: Any = gym.make(id, disable_env_checker=True).unwrapped
    sections = inspect.cleandoc(type(env).__doc__ or "").split("\n\n", 1)[1]
    observation = sections.index("## Rewards")
    shown = env.core.raw_space() if registered.track == "injection" else env.observation_space
    parts = ["## Description", registered.description.strip(), _overview(env),
             sections[:observation].strip(), _observation_table(shown, env.world),
             sections[observation:].strip(), *_returns_table(id),
             "## World", WORLD_TEXT, _world_table(registered.world)]
    return "\n\n".join(parts) + "\n"


def _returns_table(id: str) -> list[str]:
    """Return the section of published returns; empty without any."""
    rows = published_returns(id)
    if not rows:
        return []
    lines = [f"| {row['group']} | `{row['policy']}` | {float(row['mean']):.3f} ± "
             f"{float(row['half_width']):.3f} |" for row in rows]
    return ["## Returns", RETURNS_TEXT.strip(),
            "\n".join(["| group | best policy | return |", "|---|---|---:|", *lines])]


def _overview(env: Any) -> str:
    """Return a table of the sizes of an environment."""
    world = env.world
    rows = {"action space": _short(env.action_space),
            "observation space": _short(env.observation_space),
            "steps of an episode": env.episode_steps,
            "scored states": f"{world.schedule.scored_steps}: t = {world.warm_up + 1} … "
                             f"{world.n_steps}",
            "time steps before t = 0": world.spin_up_steps}
    if hasattr(env, "lag"):
        rows["lag"] = env.lag
    else:
        rules = env.rules
        rows |= {"injections before the agent's first": env.core.n_initial,
                 "gate": f"{rules.gate:g}", "inflow": rules.inflow, "faults": rules.faults,
                 "history": rules.history}
    return "\n".join(["| | |", "|---|---|", *(f"| {key} | `{value}` |"
                                              for key, value in rows.items())])


def _short(space: gym.Space) -> str:
    """Format a space without its array bounds."""
    if isinstance(space, spaces.Dict):
        return f"Dict({', '.join(space)})"
    if not isinstance(space, spaces.Box):
        return str(space)
    low, high = float(space.low.min()), float(space.high.max())
    return f"Box({low:.4g}, {high:.4g}, {space.shape}, {space.dtype})"


def _observation_table(space: spaces.Dict, world: World) -> str:
    columns, rows = world.vessel.coarse_grid_shape
    lines = []
    for name, inner in space.items():
        meaning = KEY_DESCRIPTIONS[name].format(columns=columns, rows=rows)
        lines.append(f"| `{name}` | {inner.shape} | {meaning} |")
    return "\n".join(["| key | shape | meaning |", "|---|---|---|", *lines])


def _world_table(world: World) -> str:
    """List all parameters of all components, by the names in the argument ``world``."""
    lines = ["| name | value | meaning |", "|---|---|---|"]
    for each in fields(world):
        if each.name != "name":
            meaning = _field_docs(World).get(each.name, "")
            lines += _rows(each.name, getattr(world, each.name), meaning)
    return "\n".join(lines)


def _rows(name: str, value: Any, meaning: str) -> list[str]:
    if not is_dataclass(value):
        return [f"| `{name}` | {list(value) if isinstance(value, tuple) else value} | {meaning} |"]
    kind: type = type(value)
    summary = _cell((kind.__doc__ or "").partition("\n\n")[0])
    docs = _field_docs(kind)
    return [f"| `{name}` | {kind.__name__} | {'. '.join(filter(None, [meaning, summary]))} |",
            *(row for each in fields(value)
              for row in _rows(f"{name}.{each.name}", getattr(value, each.name),
                               docs.get(each.name, "")))]


@lru_cache(maxsize=64)
def _field_docs(kind: type) -> dict[str, str]:
    """Map each field to the docstring below it in the source; empty without a source."""
    found: dict[str, str] = {}
    for each in reversed(kind.__mro__[:-1]):
        try:
            body = ast.parse(textwrap.dedent(inspect.getsource(each))).body[0]
        except (OSError, TypeError, SyntaxError):
            continue
        for line, after in pairwise(getattr(body, "body", [])):
            if (isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name)
                    and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)):
                found[line.target.id] = _cell(str(after.value.value))
    return found


def _cell(text: str) -> str:
    """Return text on one line with its bars escaped."""
    return " ".join(text.split()).replace("|", "\\|")
