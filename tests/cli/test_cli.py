"""Command line: runs, written files and error messages."""

import re
import sys
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import pytest
from eitbench import __version__
from eitbench.bench import run, tracks
from eitbench.bench.methods import builtin_methods
from eitbench.bench.tracks import ids
from eitbench.cli.app import app
from eitbench.data.seeds import parse_seeds
from eitbench.worlds import entry, registry
from typer.main import get_command

from commands import eitbench
from short import PLAIN, shorten
from tiny import OWN_WORLD, git_says, write_baseline

ROOT = Path(__file__).parents[2]
PIPE, INJECTION = "eitbench/Pipe2D-v0", "eitbench/Pipe2DInjection-v0"
COMMANDS = {name for name, each in get_command(app).commands.items() if not each.hidden}


@pytest.fixture(autouse=True)
def tiny_world(monkeypatch, tmp_path):
    """Use tiny worlds for the registered ids, an empty folder, and no git."""
    git_says(monkeypatch)
    shorten(monkeypatch, *ids())
    lagged = replace(entry("eitbench/Pipe2DFixedLag-v0"), settings={"lag": 2})
    registry.import_entries([lagged])
    monkeypatch.chdir(tmp_path)
    write_baseline(tmp_path, doc="My method: the same everywhere.")


def test_suites():
    """full has every environment; quick the plain pipe with fewer seeds, without methods that take minutes. Methods
    fitted to a real pipe are incompatible with tiny worlds. A user's file has a job for each of its subtracks."""
    jobs = run.make_jobs("estimation", [], ["mine.py"], [1], suite="quick")
    assert [job.environment.id for job in jobs] == [
        PIPE, "eitbench/Pipe2DFixedLag-v0", "eitbench/Pipe2DSmoothing-v0"]
    quick, full = (run.make_jobs("estimation", [], [], [1], suite=suite) for suite in ("quick", "full"))
    plain = set(PLAIN) & set(ids("estimation"))
    assert {job.environment.id for job in quick} == plain and len(plain) == 3
    assert {job.environment.id for job in full} == set(ids("estimation"))
    real_only = {"approximation_error_filter", "identified_flow", "real_time_filter"}
    real_only |= {name for name in builtin_methods("estimation") if name.startswith("learned_")}
    missing = {job for job in full if job.environment.id in plain} - set(quick)
    assert missing == {run.Job(tracks.Environment(PIPE), name, 1) for name in ("gauss_newton", "total_variation")}
    assert set(quick) < set(full)
    assert {job.method for job in full} == set(builtin_methods("estimation")) - real_only
    assert set(parse_seeds(tracks.QUICK_SEEDS)) < set(parse_seeds(entry(PIPE).test_seeds))
    asked_for = run.make_jobs("estimation", [PIPE], ["gauss_newton"], [1, 2], suite="quick")
    assert [job.seed for job in asked_for] == [1, 2]


@pytest.fixture
def module(tmp_path):
    (tmp_path / "my_world_of_tests.py").write_text(OWN_WORLD)
    yield "my_world_of_tests"
    sys.modules.pop("my_world_of_tests", None)
    gym.registry.pop("mine/Fast-v0", None)


def test_a_world_of_a_file_runs(module):
    """On two processes, and in a worker of an isolated method."""
    code, said, complaint = eitbench(
        "run", "--env", f"{module}:mine/Fast-v0", "--baseline", "mine.py", "--seeds", "dev:0-1",
        "-j", "2", "--isolate", "process")
    assert code == 0 and "Fast-v0" in said and "failed" not in said, complaint


def test_agents_of_two_environments_may_have_one_name(tmp_path, monkeypatch):
    """Results are stored by environment and name: only two files of one environment must have different names."""
    monkeypatch.setattr(run, "builtin_methods", lambda track: [])
    monkeypatch.setattr(run, "builtin_agents", lambda id: [write_baseline(tmp_path / id)])
    pair = ids("estimation")[:2]
    jobs = run.make_jobs("estimation", pair, [], [1], isolate="none")
    assert [job.environment.id for job in jobs] == pair
    with pytest.raises(ValueError, match="have the same name"):
        run.make_jobs("estimation", pair[:1], [job.method for job in jobs], [1], isolate="none")


def test_list_and_version():
    """The list has every environment with its subtrack, and every method with its subtracks and title."""
    assert eitbench("--version")[:2] == (0, f"eitbench {__version__}\n")
    code, said, _ = eitbench("list")
    assert code == 0
    lines = {line.split()[0]: line for line in said.splitlines()}
    assert lines.keys() >= {*ids(), *builtin_methods("estimation"), *builtin_methods("injection")}
    assert "injection" in lines["random_pair"] and "Random pair" in lines["random_pair"]
    assert "smoothing" in lines["eitbench/Pipe2DSmoothing-v0"] and "3 scored of 5" in lines[PIPE]
    assert lines["eitbench/Pipe3D-v0"].endswith("recommended to new users")
    assert lines["eitbench/Pipe2DStrongSlugs-v0"].endswith("variant strong-slugs of eitbench/Pipe2D-v0")
    assert "filter, smoothing" in lines["gauss_newton"] and "Stationary Gauss–Newton" in lines["gauss_newton"]


def test_documented_commands_are_commands():
    """Every `eitbench …` in the documents, and the workflow's `verify`, names a command and options that exist,
    according to their help."""
    workflow = (ROOT / ".github" / "workflows" / "submission.yml").read_text(encoding="utf-8")
    (call,) = re.findall(r"bin/eitbench verify (.*?)(?: >|\n)", workflow)
    named, helps = {"verify": set(re.findall("--[a-z-]+", call))}, {"verify": eitbench("verify", "--help")[1]}
    assert named["verify"]
    for path in (ROOT / "README.md", ROOT / "leaderboards" / "README.md", *(ROOT / "docs").glob("*.md")):
        text = path.read_text(encoding="utf-8").replace("\\\n", "")
        blocks = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
        lines = re.findall(r"^.*?\beitbench (.*)$", "\n".join(blocks), re.MULTILINE)
        for words in lines + re.findall(r"`eitbench ([^`]*)`", text):
            command, *rest = words.split("#")[0].split()
            if command == "fit":
                command, rest = f"fit {rest[0]}", rest[1:]
            named.setdefault(command, set()).update(word for word in rest if word.startswith("--"))
            if command not in helps:
                helps[command] = eitbench(*command.split(), "--help")[1]
    assert {command.split()[0] for command in named} == COMMANDS
    for command, options in named.items():
        assert all(re.search(rf"{option}\b", helps[command]) for option in options), (command, options)


@pytest.mark.parametrize(("arguments", "message"), [
    (["run", "--seeds", "0-3"], "seeds must have a split: train:0-3, dev:0-3 or test:0-3; got '0-3'"),
    (["run", "--env", "Pipe2D"], "Did you mean eitbench/Pipe2D-v0?"),
    (["run", "--set", "instrument.noise_relativ=0.1"], "Did you mean noise_relative?"),
    (["leaderboard", "-o", "nothing"], "no results in nothing; create some with `eitbench run`"),
    (["render", "--step", "3"], "out must end in .png with step"),
    (["render", "--baseline", "fixed_interval_smoother"], "not compatible with eitbench/Pipe2D-v0, a filter"),
    (["render", "--env", INJECTION], f"policy must be given for {INJECTION}"),
    (["render", "--env", INJECTION, "--policy", "random_pair", "--step", "1", "-o", "a.png"],
     "step must be an integer of at least 17 and at most 22, got 1"),
    (["run", "--policy", "random_pair"], "env must be given with policy"),
    (["run", "--env", INJECTION, "--baseline", "kalman_filter"], "one run must be of estimators or of injection"),
    (["policies", "--env", "x"], "use `eitbench run --env ID --policy NAME`"),
    (["bank", "--env", PIPE, "--seeds", "dev:0", "--seeds", "dev:1"], "--seeds may be given once, got 2 times"),
    (["bank", "--env", "nowhere:mine/Fast-v0"],
     "module nowhere of nowhere:mine/Fast-v0 cannot be imported: ModuleNotFoundError"),
    (["verify", "r.json", "--all"], "one of the files of records, --all and --top must be given"),
    (["verify", "r.json", "s.json", "--method", "a.py"], "--method belongs to one record's file"),
    (["verify", "r.json", "--held-out", "3"], "--held-out and --secret belong together"),
    (["verify", "r.json", "--episodes", "0"], "--episodes must be at least 1 without --held-out"),
    (["verify", "r.json"], "records must be files, got r.json"),
])
def test_mistakes_are_explained(arguments, message, tmp_path):
    """Exit code 2 and a sentence with the argument; no traceback, and no file is written."""
    code, said, complaint = eitbench(*arguments)
    assert code == 2 and said == ""
    assert message in complaint and "Traceback" not in complaint
    assert not (tmp_path / "results").exists() and not (tmp_path / "nothing").exists()


def test_a_missing_extra_is_reported(monkeypatch, tmp_path):
    """Without a reader of configurations: exit code 1 and the name of the extra."""
    monkeypatch.setitem(sys.modules, "yaml", None)
    code, said, complaint = eitbench("train", "--env", INJECTION)
    assert code == 1 and said == "" and "needs the extra bench, pip install 'eitbench[bench]'" in complaint
    assert not (tmp_path / "results").exists()
