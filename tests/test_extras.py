"""Environments need no extra; an error for a missing package names the extra that installs it."""

import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from eitbench._extras import EXTRAS

ROOT = Path(__file__).parents[1]
BASE_ONLY = f"""
import sys
for modules in {EXTRAS!r}.values():
    sys.modules.update(dict.fromkeys(modules))        # as if none were installed
"""
PLAY = """
import gymnasium as gym, eitbench
env = gym.make(sys.argv[1], render_mode="rgb_array")
env.reset(seed=0)
print(*env.step(env.action_space.sample())[1:4])
"""
WANTS = [
    ("env = __import__('gymnasium').make('eitbench/StationaryTank2D-v0', render_mode='rgb_array')\n"
     "env.reset(seed=0)\nenv.render()", "render() needs the extra bench"),
    ("eitbench.evaluate", "eitbench.evaluate needs the extra bench, pip install 'eitbench[bench]'"),
    ("eitbench.leaderboard.load()", "eitbench.leaderboard.load needs the extra bench"),
    ("from eitbench.cli.__main__ import main\nmain()", "the command eitbench needs the extra bench"),
]


def without_extras(program, *arguments):
    return subprocess.run([sys.executable, "-c", BASE_ONLY + program, *arguments], capture_output=True, text=True,
                          check=False)


@pytest.mark.parametrize("id", ["eitbench/StationaryTank2D-v0", "eitbench/Pipe2DInjection-v0"])
def test_environments_need_no_extra(id):
    done = without_extras(PLAY, id)
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("False False\n")


def test_what_is_missing_is_named():
    """Each program fails in one process, with a message that begins with the expected one."""
    run = ("import eitbench\nfor program in " + repr([program for program, _ in WANTS]) + ":\n"
           "    try:\n        exec(program, {'eitbench': eitbench})\n"
           "    except (ModuleNotFoundError, SystemExit) as error:\n        print(str(error).splitlines()[0])\n")
    done = without_extras(run)
    for line, (_, said) in zip(done.stdout.splitlines(), WANTS, strict=True):
        assert line.startswith(said), done.stderr


def test_each_extra_installs_its_packages():
    """The base dependencies contain none of the optional packages."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    distributions = packages_distributions()
    for extra, modules in EXTRAS.items():
        named = {line.partition(">=")[0].lower() for line in project["optional-dependencies"][extra]}
        named |= {"torch"} if extra == "rl" else set()                       # stable-baselines3 installs it
        for module in modules:
            (distribution,) = {name.lower().replace("_", "-") for name in distributions[module]}
            assert distribution in named, f"{module} of {extra}"
            assert not any(line.startswith(distribution) for line in project["dependencies"])
