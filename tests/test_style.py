"""The source passes the linter and the type checker, and keeps to the house rules they do not know."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FLOOR = {"numerics": 0, "scoring": 0, "physics": 1, "worlds": 2, "data": 3, "estimation": 4, "measured": 5,
         "envs": 6, "bench": 7, "report": 8, "rl": 9, "cli": 10}
"""Where each room is; those with an underscore are in the cellar, and `__init__` is the door."""


@pytest.mark.parametrize("tool", [["ruff", "check"], ["mypy"]])
def test_tool_passes(tool):
    """ruff and mypy find nothing."""
    done = subprocess.run([sys.executable, "-m", *tool], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def imported(path: Path) -> set[str]:
    """First part below ``eitbench`` of all that a file imports, inside functions too, but for what only the type
    checker reads."""
    tree = ast.parse(path.read_text())
    unread = {id(inner) for node in ast.walk(tree) if isinstance(node, ast.If)
              and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
              for inner in ast.walk(node)}
    names = set()
    for node in ast.walk(tree):
        if id(node) in unread:
            continue
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("eitbench"):
            names |= ({node.module.split(".")[1]} if "." in node.module
                      else {alias.name for alias in node.names})
        elif isinstance(node, ast.Import):
            names |= {alias.name.split(".")[1] for alias in node.names if alias.name.startswith("eitbench.")}
    return names


def test_each_floor_imports_only_from_floors_below():
    """The layout is a house: physics knows nothing of gymnasium, estimation nothing of environments, and so on."""
    package = ROOT / "eitbench"
    upwards = []
    for path in package.rglob("*.py"):
        room = path.relative_to(package).parts[0].removesuffix(".py")
        if room == "__init__":
            continue
        for other in imported(path):
            assert other in FLOOR or other.startswith("_") or other in ("Estimate", "Task"), f"{path}: {other}?"
            if FLOOR.get(other, -1) > FLOOR.get(room, -1):
                upwards.append(f"{path.relative_to(ROOT)} imports {other}")
    assert not upwards, "\n".join(upwards)


def test_importing_is_light():
    """`import eitbench` loads neither torch nor matplotlib nor the finite elements nor numba."""
    heavy = {"matplotlib", "meshio", "numba", "pandas", "skfem", "stable_baselines3", "torch"}
    code = f"import sys, eitbench; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_files_stay_short():
    """One idea a file: under 400 lines."""
    for folder in ("eitbench", "baselines", "tests", "benchmarks", "studies"):
        for path in (ROOT / folder).rglob("*.py"):
            assert len(path.read_text().splitlines()) < 400, path
