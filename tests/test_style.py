"""The source passes the linter and the type checker, and keeps to the house rules they do not know."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FLOOR = {"physics": 1, "seeds": 1, "scenarios": 2, "episodes": 2, "task": 2, "recordings": 2, "regions": 2, "bank": 2,
         "estimation": 3, "scoring": 3, "envs": 4, "pair_policy": 4, "leaderboard": 5, "imitation": 6, "training": 7,
         "cli": 8, "__init__": 8}
"""Where each room is; those with an underscore are in the cellar, 0. On floors 0 and 2 doors lead from room to room."""


@pytest.mark.parametrize("tool", [["ruff", "check"], ["mypy"]])
def test_tool_passes(tool):
    """ruff and mypy find nothing."""
    done = subprocess.run([sys.executable, "-m", *tool], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def imported(path: Path) -> set[str]:
    """First part below ``eitbench`` of everything a file imports when it is loaded (not for type checking only, nor
    when a function is called)."""
    names = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("eitbench"):
            names |= {node.module.split(".")[1]} if "." in node.module else {alias.name for alias in node.names}
    return names


def test_each_floor_imports_only_from_floors_below():
    """The layout is a house: physics knows nothing of gymnasium, estimation nothing of environments, and so on."""
    package = ROOT / "eitbench"
    for path in package.rglob("*.py"):
        room = path.relative_to(package).parts[0].removesuffix(".py")
        for other in {room, *imported(path)}:
            assert other in FLOOR or other.startswith("_"), f"{path}: on which floor is {other}?"
            here, there = FLOOR.get(room, 0), FLOOR.get(other, 0)
            assert other == room or there < here or there == here in (0, 2), f"{path} imports {other}"


def test_importing_is_light():
    """`import eitbench` loads neither torch nor matplotlib nor the finite elements."""
    code = ("import sys, eitbench; heavy = {'torch', 'matplotlib', 'skfem', 'pandas', 'stable_baselines3'}; "
            "print(sorted(heavy & set(sys.modules)))")
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_files_stay_short():
    """One idea a file: under 400 lines."""
    for folder in ("eitbench", "baselines", "tests", "benchmarks"):
        for path in (ROOT / folder).rglob("*.py"):
            assert len(path.read_text().splitlines()) < 400, path
