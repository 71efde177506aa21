"""The page of an environment: what the world says of itself, and the sizes of its objects."""

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

from eitbench.envs.estimation import EstimationEnv
from eitbench.envs.injection import InjectionEnv
from eitbench.worlds.registry import entry
from eitbench.worlds.world import World

MEANINGS = {
    "voltages": "measured electrode potentials against their mean, V, with noise",
    "currents": "injected currents, A (in 2D A per metre of depth), summing to zero",
    "recent": "the last of these, the last first",
    "frame": "voltages of the first frame; not in the scaled observation",
    "innovations": "measured less predicted, in predicted standard deviations",
    "mean": "estimate on {columns} × {rows} patches, x first, mol/m³",
    "std": "its standard deviation, mol/m³",
    "doubt": "how often lately an electrode's readings were not believed, and injections it drove",
    "velocity": "estimated mean velocity, m/s",
    "velocity_std": "its standard deviation, m/s",
    "left": "steps left, and where there is a budget injections left",
}
"""Of the entries of an observation."""
ESTIMATION_ARGUMENTS = """
| name | default | meaning |
|---|---|---|
| `lag` | {lag} | an integer from 0 to {last}, or "all" (= {last}): whole record first |
| `assume` | None | dict of what the task's model wrongly believes of the flow |
| `world` | None | numbers to change, as in `{{"instrument": {{"noise_relative": 0.02}}}}` |
| `episodes` | None | training episodes of unseeded resets; None: 1, soon 8, more, up to 1000 |
| `render_mode` | None | "rgb_array": truth, estimate, spread and active pair |
"""
INJECTION_ARGUMENTS = """
| name | default | meaning |
|---|---|---|
| `estimator` | "reduced" | a filter with few states, for training; "full": the exact one; "none" |
| `observation` | "scaled" | or "raw" |
| `gate` | {gate} | standard deviations beyond which no reading is believed; None: all are |
| `inflow` | "{inflow}" | what the filter believes flows in: "white" noise, or as "learned" |
| `world` | None | dict of numbers to change, as in `{{"schedule": {{"budget": 20}}}}`; see below |
| `episodes` | None | training episodes of unseeded resets; None: 1, soon 8, more, up to 1000 |
| `render_mode` | None | "rgb_array": truth, estimate, spread, injection |
| `threads` | 1 | vectorised only: cores that the filters may use; give BLAS one thread then |
"""


def page(id: str) -> str:
    """Markdown: what an environment asks for, shows, pays, and takes; ``ValueError`` if none."""
    registered = entry(id)
    env: Any = gym.make(id, disable_env_checker=True).unwrapped
    parts = _estimation(env) if registered.track == "estimation" else _injection(env)
    numbers = _numbers(registered.world)
    sections = {"Description": registered.about.strip(), **parts, "Numbers of the world": numbers}
    texts = [f"## {heading}\n\n{text.strip()}" for heading, text in sections.items()]
    return "\n\n".join(texts) + "\n"


def _estimation(env: EstimationEnv) -> dict[str, str]:
    world = env.world
    velocity = world.velocity_model
    asked = f"the estimate at the {env.n_nodes:,} nodes of `task.mesh`, mol/m³"
    reward = "−∫(ĉ_t − c_t)² dΩ / ∫c_t² dΩ"
    if velocity is not None:
        asked += f"; after it the flow's parameters θ ({velocity.size}), m/s"
        reward += " − ∫(v̂_t − v_t)² dy / ∫v_t² dy"
    first = world.warm_up + 1
    return {
        "Action space": f"`{_short(env.action_space)}`: {asked}. Ignored while nothing is asked "
                        "for yet.",
        "Observation space": "`Dict`, zeros once the record has been played:\n\n"
                             + _table(env.observation_space, world),
        "Reward": f"{reward} for the {world.schedule.scored_steps} scored states "
                  f"t = {first} … {world.n_steps}, else 0: minus the mean of "
                  "the first term over the scored states is ẽ_c (thesis 5.12).",
        "Starting state": f"{_flowing(world)}`reset(seed=s)` plays episode s (train, dev and test "
                          "have ranges of their own); without a seed a random one of the "
                          "training episodes, few at first. The first use of a seed simulates its "
                          "truth, which is then kept on disk; `eitbench bank` does so for many "
                          "seeds ahead of time.",
        "Episode end": f"Terminated after {world.n_steps + env.lag} steps. Never truncated.",
        "Arguments": ESTIMATION_ARGUMENTS.format(lag=env.lag, last=world.n_steps - 1)}


def _injection(env: InjectionEnv) -> dict[str, str]:
    world = env.world
    rules = env.rules
    if isinstance(env.action_space, spaces.Discrete):
        actions = (f"`Discrete({env.action_space.n})`: electrode pairs (0, 1), (0, 2), … "
                   "(`electrode_pairs`); current enters at the first and leaves at the second.")
        actions += " The last action is no injection." if rules.budget is not None else ""
    else:
        actions = (f"`{_short(env.action_space)}`: a current for each electrode, in parts of the "
                   "instrument's.")
    over = ""
    if world.region is not None:
        over = " over {:g} … {:g} m along the pipe".format(*world.region)
    gate = f"{rules.gate:g}" if rules.gate < 1e300 else None
    return {
        "Action space": actions,
        "Observation space": f"`{_short(env.observation_space)}`, about between −1 and 1; with "
                             "`observation=\"raw\"` a dict in SI units, `float64`:\n\n"
                             f"{_table(env.core.space(), world)}\n\nWith `estimator=\"none\"` "
                             "`voltages`, `currents` and `left` only, raw.",
        "Reward": f"For the {world.schedule.scored_steps} scored states, else 0: "
                  f"∫(ĉ_bh − c_t)² dΩ / ∫c_t² dΩ − ∫(ĉ_t − c_t)² dΩ / ∫c_t² dΩ{over}, by how much "
                  "the error lies below that of the homogeneous estimate, which no injection can "
                  "change. The score is ẽ_c (thesis 5.12), the mean of the second term. With "
                  "`estimator=\"none\"` the reward is always 0.",
        "Starting state": f"{_flowing(world)}The first {env.core.first} injections are the world's "
                          "own cycle; the agent takes over after them. With `estimator=\"none\"` "
                          "it chooses from the first one on.",
        "Episode end": f"Terminated after {env.core.length} steps ({world.n_steps} with "
                       "`estimator=\"none\"`). Never truncated.",
        "Arguments": INJECTION_ARGUMENTS.format(gate=gate, inflow=rules.inflow)}


def _flowing(world: World) -> str:
    return f"The fluid has been flowing for {world.lead_in} time steps. " if world.lead_in else ""


def _short(space: gym.Space) -> str:
    """A space without its thousands of bounds."""
    if not isinstance(space, spaces.Box):
        return str(space)
    low, high = float(space.low.min()), float(space.high.max())
    return f"Box({low:.4g}, {high:.4g}, {space.shape}, {space.dtype})"


def _table(space: spaces.Dict, world: World) -> str:
    columns, rows = world.vessel.patches
    lines = [f"| `{name}` | {inner.shape} | {MEANINGS[name].format(columns=columns, rows=rows)} |"
             for name, inner in space.items()]
    return "\n".join(["| key | shape | meaning |", "|---|---|---|", *lines])


def _numbers(world: World) -> str:
    """Every number of every part, by the names that the argument ``world`` takes."""
    lines = ["| name | value | meaning |", "|---|---|---|"]
    for each in fields(world):
        value = getattr(world, each.name)
        if each.name == "name":
            continue
        lines += _rows(each.name, value, _meanings(World).get(each.name, ""))
    return "\n".join(lines)


def _rows(name: str, value: Any, meaning: str) -> list[str]:
    if not is_dataclass(value):
        return [f"| `{name}` | {list(value) if isinstance(value, tuple) else value} | {meaning} |"]
    kind: type = type(value)
    first = (kind.__doc__ or "").partition("\n\n")[0]
    said = _meanings(kind)
    whole = ". ".join(filter(None, [meaning, _cell(first)]))
    return [f"| `{name}` | {kind.__name__} | {whole} |",
            *(row for each in fields(value)
              for row in _rows(f"{name}.{each.name}", getattr(value, each.name),
                               said.get(each.name, "")))]


@lru_cache(maxsize=64)
def _meanings(kind: type) -> dict[str, str]:
    """Field -> the text below it in the source, with its unit; nothing where there is no source."""
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
    """As a table's cell can hold it: in one line, its bars escaped."""
    return " ".join(text.split()).replace("|", "\\|")
