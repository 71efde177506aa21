"""An installed package in an empty folder: all commands, and the examples of the README."""

import re
import shutil
import zipfile
from pathlib import Path

import pytest
from eitbench.bench.methods import builtin_files
from eitbench.bench.records import read_record
from eitbench.bench.verify import is_builtin_record, job_for_record
from eitbench.cli.app import app
from typer.main import get_command

from tiny import ISOLATION

ROOT = Path(__file__).parents[2]
TANK = ("--env", "eitbench/StationaryTank2D-v0")
INJECTION = ("--env", "eitbench/Pipe2DInjection-v0")
RESULTS = ROOT / "leaderboards" / "results"
RECORD = "eitbench-StationaryTank2D-v0--homogeneous--v1.json"
AGENT = "eitbench-Pipe2DInjectionFlow-v0--ppo_seed0--v1.json"
TINY = "{total_steps: 0, n_envs: 1, evaluation_episodes: 1, episodes: 1}"
COMMANDS = [
    (["list"], "eitbench/Pipe2D-v0"),
    (("run", *TANK, "--baseline", "homogeneous", "--seeds", "dev:0", "-j", "1"), "wrote results/index.html"),
    (["leaderboard"], "wrote results/index.html"),
    (("bank", *TANK, "--seeds", "train:0", "-j", "1"), "1 simulated"),
    (("export", *TANK, "--seeds", "train:0", "-o", "episodes", "-j", "1"), "1 episodes written"),
    (("run", *INJECTION, "--policy", "opposite", "--seeds", "dev:0", "--estimator", "reduced", "-j", "1", "--set",
      "schedule.scored_steps=4"), "opposite"),
    (("train", *INJECTION, "--config", "tiny.yml", "-o", "agent"), "wrote agent/model.zip"),
    (("submit", *TANK, "--baseline", "homogeneous", "--seeds", "test:0", "--to", "mine/results", "-j", "1"),
     "1 episodes"),
    (("leaderboard", "--records", "mine/results"), "wrote mine/site/index.html"),
    (("verify", "--all", "--records", "two", "--episodes", "1", "-j", "1"), "2 of 2 records agree"),
    (("compare", "kalman_filter", "extended_kalman_filter"), "extended_kalman_filter"),
    (("render", *TANK, "--baseline", "homogeneous", "--step", "3", "-o", "it.png"), "wrote it.png"),
    (("golden", "eitbench/StationaryTank2D-v0"), "StationaryTank2D-v0: same"),
    (("fit", "prior", "--env", "eitbench/Pipe2D-v0", "--seeds", "train:0-3", "-o", "prior.json"), "prior.json: "),
    (("fit", "model", "--env", "eitbench/Pipe2D-v0", "--seeds", "train:0", "-o", "model.npz"), "model.npz: "),
    (("estimate", "--help"), "vessel"),
    (("fetch", "--help"), "sha256"),
]
"""Command-line arguments, and a part of the output of a successful run."""


@pytest.fixture(scope="module")
def empty(installed):
    """Return a folder outside the checkout, with files of these tests only."""
    folder = installed.folder / "empty"
    folder.mkdir()
    (folder / "tiny.yml").write_text(TINY)
    (folder / "two").mkdir()
    for record in (RECORD, RECORD.replace("homogeneous", "kalman_filter")):
        shutil.copy(RESULTS / record, folder / "two")
    shutil.copy(RESULTS / AGENT, folder)
    return folder


def test_the_wheel_is_small_and_whole(installed):
    """Agents' models, animations, records and the rendered site are not part of the package."""
    (wheel,) = (installed.folder / "wheels").glob("eitbench-*.whl")
    assert wheel.stat().st_size < 5e6
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {"eitbench/py.typed", "eitbench/leaderboards/schema.json", "eitbench/leaderboards/episodes.csv.xz",
            "eitbench/baselines/rl/ppo.yml", "eitbench/baselines/golden/homogeneous.json"} <= names
    assert not [name for name in names if name.startswith("eitbench/leaderboards/results")]
    assert not [name for name in names if Path(name).suffix in (".zip", ".webp", ".html")
                and not name.startswith("eitbench/report")]


def test_every_command_works_in_an_empty_folder(installed, empty):
    """Commands run in the order of a first session: each uses files of earlier ones."""
    shown = {name for name, command in get_command(app).commands.items() if not command.hidden}
    assert {words[0] for words, _ in COMMANDS} == shown
    installed.commands(COMMANDS, cwd=empty)


def test_what_the_readme_shows_works(installed, empty):
    """All Python blocks run, with a short training of the agent, and the records load as a table."""
    readme = (ROOT / "README.md").read_text()
    shown = "\n".join(re.findall(r"```python\n(.*?)```", readme, re.DOTALL))
    assert "env).learn(100_000)" in shown
    shown = shown.replace("env).learn(100_000)", "env, n_steps=16, batch_size=16).learn(16)")
    said = installed("-c", f"{shown}\nprint(len(eitbench.leaderboard.load()))", cwd=empty)
    assert int(said.split()[-1]) > 10_000


def test_an_agent_s_record_asks_for_its_model(installed, empty, tmp_path):
    """An error names an agent that is not part of the package; a copy of its model is identified as built-in."""
    said = installed("-m", "eitbench.cli", "verify", AGENT, "--episodes", "1", cwd=empty, code=1)
    assert "checkpoints of built-in agents are in a checkout only" in said
    record = read_record(RESULTS / AGENT)
    ours = builtin_files(record["environment"]["id"])[record["method"]]
    copy = shutil.copy(ours, tmp_path / "model.zip")
    assert job_for_record(record, copy, ISOLATION).method == str(copy) and is_builtin_record(record, str(copy))
    assert not is_builtin_record(record | {"method_sha256": "0" * 64}, str(copy))
