"""A third-party package: its world, method and score work like built-in ones, without changes to eitbench."""

import csv
import json

import numpy as np
import pytest

from tiny import ISOLATION

ID = "bubbles/BubbleTank-v0"
INJECTION = "bubbles/BubbleTankInjection-v0"


def test_worlds_are_known_without_being_imported(installed):
    """`gym.make`, vectorised environments and pages need the id only."""
    said = installed("-c", f"""
import eitbench
import gymnasium as gym
env = gym.make({ID!r})
observation, _ = env.reset(seed=3)
print(observation["voltages"].shape, env.action_space.shape)
many = gym.make_vec({INJECTION!r}, num_envs=3, episodes=3)
print(len(many.reset(seed=3)[0]))
print(eitbench.describe_environment({ID!r}))
""")
    assert said.startswith("(12,) (441,)\n3\n") and "A bubble rises" in said


def test_method_and_score_make_a_record_and_a_board(installed):
    """Its tracker is better than the naive baseline, its score is in the record, the CSV and `compare`, and the
    submission is verified. Built-in policies run on its world, and an episode is rendered."""
    records = installed.folder / "boards" / "records"
    methods = ("homogeneous", "bubble_tracker", "gauss_newton")
    installed.commands([
        (["list"], ID), (["list"], INJECTION),
        *((["submit", "--baseline", method, "--env", ID, "--seeds", "test:0", "--to", records, "--jobs", 1], method)
          for method in methods),
        (["leaderboard", "--records", records], "wrote"),
        (["compare", "bubble_tracker", "gauss_newton", "--records", records, "--score", "bubble_distance"],
         "distance of A"),
        (["verify", "--top", 2, "--records", records, "--episodes", 1, "--jobs", 1, "--isolate", ISOLATION],
         "2 of 2 records agree"),
        (["run", "--env", INJECTION, "--policy", "random_pair", "--policy", "opposite", "--seeds", "dev:0",
          "--estimator", "reduced", "--out", "played", "--jobs", 1], "opposite"),
        (["render", "--env", ID, "--baseline", "bubble_tracker", "--step", 20, "--out", "bubble.png"], "wrote"),
    ])
    scores = {}
    for path in records.glob("*.json"):
        record = json.loads(path.read_text())
        scores[record["method"]] = [episode["scores"] for episode in record["episodes"]]
        assert {len(episode) for episode in scores[record["method"]]} == {18}
    error = {name: np.mean([each["error"] for each in own]) for name, own in scores.items()}
    assert error.keys() == set(methods) and error["bubble_tracker"] < 0.8 * error["homogeneous"]
    distance = [each["bubble_distance"] for each in scores["bubble_tracker"]]
    assert 0.0 < max(distance) < 0.03
    with open(records.parent / "leaderboard.csv", encoding="utf-8") as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    assert float(rows["bubble_tracker"]["bubble_distance"]) == pytest.approx(np.mean(distance), 1e-5)
    assert (installed.folder / "bubble.png").read_bytes().startswith(b"\x89PNG")
