"""Environments need no extra; an error for a missing package names the extra that installs it."""

import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

from eitbench._extras import EXTRAS

ROOT = Path(__file__).parents[1]
BASE_ONLY = f"""
import sys
for modules in {EXTRAS!r}.values():
    sys.modules.update(dict.fromkeys(modules))        # as if none were installed
"""
PLAY = """
import gymnasium as gym, eitbench
for id in ("eitbench/StationaryTank2D-v0", "eitbench/Pipe2DInjection-v0"):
    env = gym.make(id, render_mode="rgb_array")
    env.reset(seed=0)
    print(*env.step(env.action_space.sample())[2:4])
"""
WANTS = [
    ("env = __import__('gymnasium').make('eitbench/StationaryTank2D-v0', render_mode='rgb_array')\n"
     "env.reset(seed=0)\nenv.render()", "render() needs the extra bench"),
    ("eitbench.evaluate", "eitbench.evaluate needs the extra bench, pip install 'eitbench[bench]'"),
    ("eitbench.leaderboard.load()", "eitbench.leaderboard.load needs the extra bench"),
    ("from eitbench.cli.__main__ import main\nmain()", "the command eitbench needs the extra bench"),
]


def test_environments_need_no_extra_and_what_is_missing_is_named():
    """Environments run, and other programs fail with a message that begins with the expected one, in one process."""
    run = (BASE_ONLY + PLAY + "for program in " + repr([program for program, _ in WANTS]) + ":\n"
           "    try:\n        exec(program, {'eitbench': eitbench})\n"
           "    except (ModuleNotFoundError, SystemExit) as error:\n        print(str(error).splitlines()[0])\n")
    done = subprocess.run([sys.executable, "-c", run], capture_output=True, text=True, check=False)
    expected = ["False False", "False False", *(said for _, said in WANTS)]
    for line, said in zip(done.stdout.splitlines(), expected, strict=True):
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
