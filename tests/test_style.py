"""The source passes the linter and the type checker, and meets the design's layers and line budgets."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "eitbench"
BUDGETS = {"numerics": 1676, "scoring": 205, "physics": 1716, "worlds": 2782, "data": 1501, "estimation": 6662,
           "measured": 2106, "envs": 1653, "bench": 4673, "report": 2680, "rl": 863, "cli": 975}
"""Package (or module) -> lines of Python allowed, blank lines and docstrings included. Each imports only from those
before it."""
TOP = 436
"""Lines allowed in the other modules at the top: public names, argument checks, files, messages."""
BASELINES = 2290
TESTS = 18_303
MODULES = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
           for path in PACKAGE.rglob("*.py")}


def lines(*paths: Path) -> int:
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def imports(path: Path) -> set[str]:
    """Return the modules of eitbench that a file imports, also inside functions and under ``TYPE_CHECKING``."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("eitbench"):
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                found.add(inner if inner in MODULES else node.module)
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found & MODULES.keys()


def layer(module: str) -> str:
    """Return the package or top-level module of a module's name; empty for ``eitbench`` itself."""
    return module.split(".")[1] if "." in module else ""


@pytest.mark.parametrize("tool", [["ruff", "check"], ["mypy"]])
def test_tool_passes(tool):
    """ruff and mypy find nothing."""
    done = subprocess.run([sys.executable, "-m", *tool], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_each_package_imports_only_from_those_before_it():
    """Imports inside functions and for the type checker obey the layers too."""
    order = list(BUDGETS)
    upwards = [f"{module} imports {other}" for module, path in MODULES.items() for other in imports(path)
               if layer(module) in order and layer(other) in order
               and order.index(layer(other)) > order.index(layer(module))]
    assert not upwards, "\n".join(upwards)
    unknown = {layer(module) for module in MODULES} - {*order, ""}
    assert all(name.startswith("_") for name in unknown), unknown


def test_no_modules_import_each_other():
    """Imports have no cycle: removing modules that no remaining one imports leaves none."""
    graph = {module: imports(path) - {module} for module, path in MODULES.items() if layer(module)}
    while leaves := [module for module, others in graph.items() if not others & graph.keys()]:
        for module in leaves:
            del graph[module]
    assert not graph, f"modules in or above a circle: {', '.join(sorted(graph))}"


@pytest.mark.parametrize(("name", "budget"), [*BUDGETS.items(), ("baselines", BASELINES), ("tests", TESTS)])
def test_package_keeps_to_its_budget(name, budget):
    folder = ROOT / name if name in ("baselines", "tests") else PACKAGE / name
    paths = list(folder.rglob("*.py")) if folder.is_dir() else [folder.with_suffix(".py")]
    assert lines(*paths) <= budget


def test_top_level_keeps_to_its_budget():
    """Sizes exclude modules that are separate layers."""
    assert lines(*(path for path in PACKAGE.glob("*.py") if path.stem not in BUDGETS)) <= TOP


def test_importing_is_light():
    """`import eitbench` loads neither torch nor matplotlib nor the finite elements nor numba."""
    heavy = {"matplotlib", "meshio", "numba", "pandas", "skfem", "stable_baselines3", "torch"}
    code = f"import sys, eitbench; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
