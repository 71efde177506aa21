"""The source passes the linter and the type checker, and keeps to the house rules they do not know."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FLOOR = {"physics": 1, "scenarios": 2, "episodes": 2, "task": 2, "recordings": 2, "bank": 2, "estimation": 3,
         "scoring": 3, "envs": 4, "leaderboard": 5, "cli": 6}


@pytest.mark.parametrize("tool", [["ruff", "check"], ["mypy"]])
def test_tool_passes(tool):
    """ruff and mypy find nothing."""
    done = subprocess.run([sys.executable, "-m", *tool], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def imported(path: Path) -> set[str]:
    """First part below ``eitbench`` of everything a file imports when it runs (not for type checking only)."""
    names = set()
    for node in ast.parse(path.read_text()).body:
        for inner in [node] if not isinstance(node, ast.If) else []:
            if isinstance(inner, ast.ImportFrom) and (inner.module or "").startswith("eitbench."):
                names.add(inner.module.split(".")[1])
    return names


def test_each_floor_imports_only_from_floors_below():
    """The layout is a house: physics knows nothing of gymnasium, estimation nothing of environments, and so on."""
    package = ROOT / "eitbench"
    for path in package.rglob("*.py"):
        room = path.relative_to(package).parts[0].removesuffix(".py")
        if room in FLOOR:
            for other in imported(path):
                assert other == room or FLOOR.get(other, 0) < FLOOR[room] or (other in (
                    "task", "episodes", "scenarios", "recordings") and FLOOR[room] == 2), f"{path} imports {other}"


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
