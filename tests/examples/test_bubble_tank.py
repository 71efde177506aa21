"""A package from outside: its world, method and score do what ours do, and no file of ours is touched."""

import csv
import json
import os
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
ID = "bubbles/BubbleTank-v0"
INJECTION = "bubbles/BubbleTankInjection-v0"


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Runs commands in a fresh virtual environment, into which two wheels were installed: ours and
    that of the example. What they need comes from here."""
    folder = tmp_path_factory.mktemp("fresh")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    subprocess.run([*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", folder / "wheels", ROOT,
                    ROOT / "examples" / "bubble_tank"], check=True)
    venv.create(folder / "venv")
    packages = next((folder / "venv").glob("lib/python*/site-packages"))
    subprocess.run([*pip, "install", "--no-deps", "--no-index", "--target", packages,
                    *(folder / "wheels").glob("*.whl")], check=True)
    (packages / "what_they_need.pth").write_text(sysconfig.get_path("purelib") + "\n")
    python = folder / "venv" / "bin" / "python"

    def run(*arguments, code=0):
        done = subprocess.run(
            [python, *arguments], cwd=folder, capture_output=True, text=True, check=False,
            env=os.environ | {"EITBENCH_CACHE": str(folder / "cache"), "OPENBLAS_NUM_THREADS": "1"})
        assert done.returncode == code, done.stdout + done.stderr
        return done.stdout

    run.folder = folder
    where = run("-c", "import eitbench; print(eitbench.__file__)").strip()
    assert Path(where).is_relative_to(folder)
    return run


def eitbench(installed, *arguments):
    return installed("-m", "eitbench.cli", *arguments)


def test_worlds_are_known_without_being_imported(installed):
    """`gym.make`, vectors and pages, by the id alone."""
    said = installed("-c", f"""
import eitbench
import gymnasium as gym
env = gym.make({ID!r})
observation, _ = env.reset(seed=3)
print(observation["voltages"].shape, env.action_space.shape)
many = gym.make_vec({INJECTION!r}, num_envs=3, episodes=3)
print(len(many.reset(seed=3)[0]))
print(eitbench.page({ID!r}))
""")
    assert said.startswith("(12,) (441,)\n3\n") and "A bubble rises" in said
    assert ID in eitbench(installed, "list") and INJECTION in eitbench(installed, "list")


def test_method_and_score_make_a_record_and_a_board(installed):
    """Its tracker beats the floor, its score is in the record, in the CSV and in `compare`; what was
    submitted is true."""
    results, records = installed.folder / "results", installed.folder / "boards" / "records"
    for method in ("homogeneous", "bubble_tracker", "gauss_newton"):
        eitbench(installed, "submit", "--baseline", method, "--env", ID, "--seeds", "test:0-1",
                 "--out", str(results), "--to", str(records), "--jobs", "1")
    scores = {}
    for path in records.glob("*.json"):
        record = json.loads(path.read_text())
        scores[record["method"]] = [episode["scores"] for episode in record["episodes"]]
        assert {len(episode) for episode in scores[record["method"]]} == {11}
    error = {name: np.mean([each["error"] for each in own]) for name, own in scores.items()}
    assert error["bubble_tracker"] < 0.8 * error["homogeneous"]
    distance = [each["bubble_distance"] for each in scores["bubble_tracker"]]
    assert 0.0 < max(distance) < 0.03
    eitbench(installed, "leaderboard", "--records", str(records))
    with open(records.parent / "leaderboard.csv", encoding="utf-8") as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    assert float(rows["bubble_tracker"]["bubble_distance"]) == pytest.approx(1e3 * np.mean(distance), 1e-5)
    said = eitbench(installed, "compare", "bubble_tracker", "gauss_newton", "--records", str(records),
                    "--score", "bubble_distance")
    assert "distance of bubble_tracker" in said
    path = next(records.glob("*bubble_tracker*.json"))
    eitbench(installed, "verify", str(path), "--episodes", "1")


def test_policies_and_pictures(installed):
    """Our policies play its world, and an episode is drawn."""
    said = eitbench(installed, "policies", "--env", INJECTION, "--policy", "random_pair", "--policy",
                    "opposite", "--seeds", "dev:0-1", "--estimator", "reduced",
                    "--out", str(installed.folder / "played"))
    assert "random_pair" in said and "opposite" in said
    picture = installed.folder / "bubble.png"
    eitbench(installed, "render", "--env", ID, "--baseline", "bubble_tracker", "--seed", "dev:0",
             "--step", "20", "--out", str(picture))
    assert picture.read_bytes().startswith(b"\x89PNG")
