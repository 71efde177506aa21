"""`eitbench.evaluate`: the scores of the commands, in Python, for classes, names and files."""

import os

import eitbench
import gymnasium as gym
import numpy as np
import pytest
from eitbench import Estimate
from eitbench.bench.run import Job, run_episode

from short import FAST, shorten
from tiny import FILTER, write_baseline

INJECTION = "eitbench/Pipe2DInjection-v0"


@pytest.fixture(autouse=True)
def tiny_world(monkeypatch):
    shorten(monkeypatch, INJECTION)


class Level:
    """Homogeneous estimate: a constant plus the sum of the voltages."""

    def __init__(self, task):
        self.level = np.full(task.mesh.n_nodes, 29.0)

    def update(self, voltages, currents):
        return Estimate(self.level + voltages.sum())


def without_time(table):
    return table.drop(columns=["seconds_per_step", "method"])


def test_scores_agree_with_the_commands(tmp_path):
    """The scores agree for a class, for its file, for an environment that was made before, and in two processes."""
    table = eitbench.evaluate(Level, FILTER.id, "dev:0-2", world=FAST)
    assert table["seed"].tolist() == ["dev:0", "dev:1", "dev:2"] and set(table["method"]) == {"Level"}
    path = write_baseline(tmp_path, update="return Estimate(self.level + voltages.sum())")
    for seed, error, bias in zip((100_000, 100_001, 100_002), table["error"], table["contrast_error"], strict=True):
        said = run_episode(Job(FILTER, path, seed))[0]["scores"]
        assert (said["error"], said["contrast_error"]) == (error, bias) and error > 0
    file = eitbench.evaluate(path, FILTER.id, [100_000, 100_001, 100_002], world=FAST)
    made = eitbench.evaluate(Level, gym.make(FILTER.id, world=FAST), "dev:0-2")
    both = eitbench.evaluate(Level, FILTER.id, "dev:0-2", world=FAST, n_jobs=2)
    for other in (file, made, both):
        assert without_time(other).equals(without_time(table))
    assert set(table["environment"]) == {f"{FILTER.id}{FILTER.name.removeprefix('eitbench-Pipe2D-v0')}"}


def test_policies_too():
    """A built-in policy by name, and a user's class."""
    class First:
        def __init__(self, rules, random):
            self.limit = rules.limit

        def act(self, observation):
            return 0

    ours = eitbench.evaluate("random_pair", INJECTION, "dev:0-1", estimator="reduced")
    mine = eitbench.evaluate(First, INJECTION, "dev:0-1", estimator="reduced")
    assert list(ours.columns) == list(mine.columns) and (ours["spent"] == mine["spent"]).all()
    assert (ours["error"] != mine["error"]).all()
    env = gym.make(INJECTION)                               # its filter is the reduced one
    env.reset(seed=100_000)
    rewards, ended = [], False
    while not ended:
        _, reward, ended, _, _ = env.step(0)
        rewards.append(reward)
    assert mine["return"][0] == sum(rewards) and mine["environment"][0] != INJECTION
    with pytest.raises(ValueError, match=r"estimator must be None for eitbench/Pipe2D-v0"):
        eitbench.evaluate(Level, FILTER.id, "dev:0", estimator="reduced")


def test_exceptions_of_the_method_propagate():
    """The method's exception propagates, with a note that names the episode."""
    class Fails(Level):
        def update(self, voltages, currents):
            raise ZeroDivisionError("dry")

    with pytest.raises(ZeroDivisionError, match="dry") as caught:
        eitbench.evaluate(Fails, FILTER.id, "dev:0", world=FAST)
    assert caught.value.__notes__ == ["Fails on eitbench/Pipe2D-v0, dev:0"]


def test_a_file_is_isolated_on_request(tmp_path):
    """An isolated file has the same scores in another process; a class cannot be isolated."""
    log = tmp_path / "log"
    path = write_baseline(tmp_path, init=f"print(os.getpid(), file=open({str(log)!r}, 'a'))",
                          update="return Estimate(self.level + voltages.sum())")
    here, apart = (eitbench.evaluate(path, FILTER.id, "dev:0", world=FAST, isolate=isolate)
                   for isolate in (None, "process"))
    assert without_time(apart).equals(without_time(here))
    first, second = map(int, log.read_text().split())
    assert first == os.getpid() != second
    with pytest.raises(ValueError, match="method must be a name or a path to be isolated, got type"):
        eitbench.evaluate(Level, FILTER.id, "dev:0", isolate="process")


@pytest.mark.parametrize(("arguments", "message"), [
    ((3, FILTER.id, "dev:0"), r"method must be a class with update\(voltages, currents\), or the name"),
    ((Level, FILTER.id, []), "seeds must name at least one episode"),
    ((Level, FILTER.id, [-1]), "seeds must be an integer of at least 0, got -1"),
    ((Level, 3, "dev:0"), "env must be an id, or made by gymnasium.make, got int")])
def test_mistakes_are_explained(arguments, message):
    with pytest.raises(ValueError, match=message):
        eitbench.evaluate(*arguments)
