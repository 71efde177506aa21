"""Records as strangers may leave them, by a seed: valid, damaged, hostile."""

import json
import random
from collections.abc import Callable
from typing import Any

from eitbench.bench.records import sealed
from eitbench.bench.tracks import named

from tiny import BOARD_IDS, RUN, record

IDS = {"filter": [BOARD_IDS["filter"], "eitbench/RotatingTank2D-v0", "eitbench/Pipe2DObstacle-v0"],
       "fixed-lag": [BOARD_IDS["fixed-lag"]], "smoothing": [BOARD_IDS["smoothing"], "eitbench/Pipe3DSmoothing-v0"],
       "injection": [BOARD_IDS["injection"], "eitbench/Pipe2DInjectionFaults-v0"]}
NAMES = ["mine", "a b", "<i>odd", "'quote\"", "Ω卡", "x" * 100, "a|b", "x..", "%2e%2e", "*", "[a](b)", "&lt;", "~",
         "con", "-rf", "{{ 7*7 }}", "{% raw %}", "?#", "a&b=c", "é", "e\u0301"]
SIZES = [0.0, 1e-100, 1e-12, 0.01, 0.2, 1.0, 7.0, 1e6, 1e30, 1e50]
TEXTS = ["", "x" * 120, "<script>alert(1)</script>", "| a | b |", "\x1b[2J", "\u202eevil", "a\nb", "\x00", "{{ 7*7 }}",
         "](http://x)", "\ud800", "\u2028", "a" * 10**5, "&amp;", "]]>", "--><b>", "';drop"]
NUMBERS = [float("nan"), float("inf"), -float("inf"), 1e308, -1.0, 10**400, 2**63, -(2**63), 5e-324, 1e51, True, -0.0]
OTHERS: list[Any] = [None, [], {}, "", 0, [[]], {"a": {}}, [None], "null", False]


def honest(chance: random.Random, i: int) -> dict[str, Any]:
    """A valid record, however odd: names, sizes, failures, versions, arguments."""
    board = chance.choice(list(IDS))
    id = chance.choice(IDS[board])
    seeds = chance.sample(range(12), chance.randint(1, 10))
    errors = {f"test:{seed}": None if chance.random() < 0.1 else chance.choice(SIZES) * chance.choice([1.0, 0.5])
              for seed in sorted(seeds)}
    errors = {seed: None if error is None else max(error, 1e-100) * (error > 0) for seed, error in errors.items()}
    scores = {name: chance.choice([None, 0.5, *SIZES]) for name in ("nis", "crps", "coverage_50", "spent", "odd_1")}
    version = chance.choice(["1", "v3", "v12"])
    made = record(f"{chance.choice(NAMES)[:90]}{i}", errors, board=board, id=id, version=version,
                  title=chance.choice(["Fine", "| a", "<b>", "Ω" * 120, "a\\"]), scores=scores,
                  role=chance.choice([None, None, "floor", "reference"]), privileged=chance.random() < 0.1,
                  parameters={chance.choice(TEXTS[:5]): chance.choice([1, [1, 2], {"a": None}, "\x1b"])},
                  official=chance.random() < 0.3, runs=[RUN | {"command": chance.choice(TEXTS[:5])}],
                  finished=chance.choice(["2025-01-01", "0000-99-99"]))
    if chance.random() < 0.2 and board != "injection":
        given = {"assume": {chance.choice(["flow", "|"]): chance.choice([1, "real", None, [1], {"a": "<b>"}])}}
        made = made | {"environment": {"id": id, "name": named(id, given), "kwargs": given}}
    return sealed(made)


def places(value: Any, path: tuple = ()) -> list[tuple]:
    """Where something stands in a record."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(place for key, each in inner for place in places(each, (*path, key)))]


def changed(whole: Any, place: tuple, value: Any) -> Any:
    """With something else in one place; ``...`` takes it away."""
    copy = json.loads(json.dumps(whole))
    inner = copy
    for key in place[:-1]:
        inner = inner[key]
    if value is ...:
        del inner[place[-1]]
    else:
        inner[place[-1]] = value
    return copy


def resealed(content: dict[str, Any]) -> dict[str, Any]:
    """As somebody would do who knows how; left alone where it cannot be done."""
    try:
        return sealed(content)
    except ValueError:
        return content


def damaged(chance: random.Random, text: str) -> bytes:
    """Cut, doubled, with bytes that are others."""
    data = bytearray(text.encode())
    ways: list[Callable[[], bytes]] = [
        lambda: bytes(data[:chance.randrange(len(data))]), lambda: bytes(data) * 2, lambda: b"", lambda: b"\xff\xfe",
        lambda: bytes(data).replace(b'"', b"'"), lambda: b"[" * 10**5, lambda: bytes(data[::-1]),
        lambda: bytes(data).replace(b"0.", b"9" * 400 + b".", 1), lambda: b'{"a":' * 10**4, lambda: b"null"]
    if chance.random() < 0.4:
        for _ in range(chance.randint(1, 4)):
            data[chance.randrange(len(data))] = chance.randrange(256)
        return bytes(data)
    return chance.choice(ways)()


def hostile(chance: random.Random, made: dict[str, Any]) -> dict[str, Any]:
    """Sealed by who knows how, with something in it that should not be."""
    whole = made
    for _ in range(chance.randint(1, 3)):
        spots = [place for place in places(whole) if place]
        value = chance.choice([*TEXTS, *NUMBERS, *OTHERS, ...])
        whole = changed(whole, chance.choice(spots), value)
    return resealed(whole)


def special(chance: random.Random, made: dict[str, Any]) -> dict[str, Any]:
    """What somebody thinks of who has read the code."""
    id = made["environment"]["id"]
    given = chance.choice([{"scenario": 5}, {"world": 5}, {"world": {"flow": 1}}, {"lag": 10**18}, {"lag": -1},
                           {"assume": [1]}, {"world": {"vessel": {"electrodes_per_wall": 10**9}}}, {"lag": "all"}])
    ways: list[dict[str, Any]] = [
        {"environment": {"id": id, "name": named(id, given), "kwargs": given}},
        {"board": chance.choice(list(IDS))}, {"method": "homogeneous", "role": None}, {"method": "random_pair"},
        {"version": "v" + "9" * chance.choice([3, 9, 5000])}, {"method": "x" * 230}, {"method": "a\x1bb"},
        {"seeds": [{}] * 20_000}, {"split": "dev"}, {"official": True, "runs": [RUN | {"dirty": True}]},
        {"runs": [RUN | {"walls": [{"a": i} for i in range(20_000)]}]}, {"runs": [RUN] * 20_000},
        {"episodes": made["episodes"] * 50}, {"parameters": {"a": [0] * 10**5}},
        {"episodes": [each | {"step_errors": [0.1] * chance.randint(1, 9)} if each["status"] == "ok" else each
                      for each in made["episodes"]]}]
    return resealed(made | chance.choice(ways))
