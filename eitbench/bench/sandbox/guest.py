"""The process in which somebody else's estimator or policy runs; `eitbench.bench.sandbox.keeper`
starts it.

It is told the environment's id and arguments, and then, step by step, what was measured. There is
no episode, no truth and no seed here, and once the wall is up none of the files in which they might
be kept can be opened.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np

from eitbench._foreign import traceback_of, where_of
from eitbench.bench.sandbox import wall, wire
from eitbench.bench.sandbox.keeper import Limits
from eitbench.worlds import streams
from eitbench.worlds.registry import take_over

Reply = tuple[dict[str, Any], dict[str, np.ndarray]]


def main(folder: str, limits: Limits, separate: list[str]) -> None:
    """Answer one message after another until the other side hangs up.

    ``folder`` is the only one where the guest can write, ``limits`` what it may take, ``separate``
    the namespaces that it has to itself.
    """
    private = Path(folder)
    incoming, outgoing = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    silent = os.open(os.devnull, os.O_RDWR)
    for stream in range(3):  # what the guest prints is no answer
        os.dup2(silent, stream)
    prints = _Prints()
    sys.stdout = sys.stderr = prints
    readable = wall.python_files()
    walls = list(separate)
    wall.limit(limits, counts_apart="user" in separate)
    if wall.drop_capabilities():
        walls.append("capabilities")
    if wall.close_files(readable, [private, Path(os.devnull)]):
        walls.append("landlock")
    if wall.refuse_calls(signals="pid" in walls or wall.landlock_version() >= 6):
        walls.append("seccomp")

    def read(n: int) -> bytes:
        content = incoming.read(n)
        if len(content) < n:
            raise EOFError
        return content

    def say(words: dict[str, Any], arrays: dict[str, np.ndarray] | None = None) -> None:
        outgoing.write(wire.pack(words | prints.taken(), arrays))
        outgoing.flush()

    say({"walls": sorted(walls), "readable": [str(place) for place in readable],
         "process": wall.own_number()})
    answer: Callable[..., Reply] = _nothing
    own = Path()
    while True:
        try:
            words, arrays = wire.unpack(read)
        except EOFError:
            return
        try:
            if words["do"] == "play":
                own = Path(words["name"])
                answer, about = _player(words, arrays)
                say(about)
            else:
                say(*answer(words, arrays))
        except (Exception, SystemExit) as error:
            say({"error": f"{type(error).__name__}: {error}", "where": where_of(error, own),
                 "traceback": traceback_of(error, own)})


class _Prints(io.TextIOWrapper):
    """Where the method prints: the first letters go along with the next answer."""

    def __init__(self) -> None:
        super().__init__(io.BytesIO())
        self._kept = ""

    def write(self, text: str) -> int:
        self._kept = (self._kept + text)[:wire.PRINTED]
        return len(text)

    def taken(self) -> dict[str, str]:
        """What there is, as words of an answer."""
        printed = self._kept.encode(errors="replace").decode()
        self._kept = ""
        return {"printed": printed} if printed else {}


def _nothing(words: dict[str, Any], arrays: dict[str, np.ndarray]) -> Reply:
    raise ValueError("the first message must be 'play'")


def _player(words: dict[str, Any], arrays: dict[str, np.ndarray],
            ) -> tuple[Callable[..., Reply], dict[str, Any]]:
    """What answers from now on, and what the method says of itself."""
    import gymnasium as gym

    from eitbench.bench.methods import load_method
    if arrays["told"].size:  # what the host says may be believed
        take_over([cloudpickle.loads(arrays["told"].tobytes())])
    env: Any = gym.make(words["id"], disable_env_checker=True, **words["kwargs"]).unwrapped
    loaded = load_method(words["name"], words["track"])
    if words["track"] == "estimation":
        known = env.task
        answer = _estimator(known, loaded)
    else:
        known = env.rules
        answer = _policy(known, loaded)
    about = {name: getattr(loaded, name)
             for name in ("name", "title", "boards", "parameters", "role", "privileged")}
    return answer, about | {"suits": loaded.suits(known)}


def _estimator(task: Any, method: Any) -> Callable[..., Reply]:
    estimator = None

    def answer(words: dict[str, Any], arrays: dict[str, np.ndarray]) -> Reply:
        nonlocal estimator
        if words["do"] == "begin":
            estimator = method.make(task)
            return {}, {}
        assert estimator is not None
        estimate = estimator.update(arrays["voltages"], arrays["currents"])
        if estimate is None:
            return {"estimate": None}, {}
        if not hasattr(estimate, "_asdict"):
            return {"estimate": type(estimate).__name__}, {}
        said = {key: np.asarray(value) for key, value in estimate._asdict().items()
                if value is not None}
        return {"estimate": "Estimate"}, said

    return answer


def _policy(rules: Any, method: Any) -> Callable[..., Reply]:
    player = None

    def answer(words: dict[str, Any], arrays: dict[str, np.ndarray]) -> Reply:
        nonlocal player
        if words["do"] == "begin":
            player = method.make(rules, streams.in_state(words["random"]))
            return {}, {}
        assert player is not None
        return {}, {"action": np.asarray(player.act(arrays))}

    return answer
