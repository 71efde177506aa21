"""Our trained agents: each is whole, loads, and plays as it did when it was kept."""

import json

import numpy as np
import pytest

from eitbench.envs import INJECTION
from eitbench.leaderboard.baselines import baseline_folder
from eitbench.leaderboard.policies import load_policy, own_agents, play

FOLDER = baseline_folder() / "checkpoints"
AGENTS = [path for env in INJECTION for path in own_agents(env)]
FIRST = 100_000
"""The first dev episode, with which evaluations begin."""


def test_every_checkpoint_is_an_agent_of_an_environment():
    """None lies where nobody finds it, and all together stay small enough for git."""
    assert sorted(AGENTS) == sorted(map(str, FOLDER.glob("**/model.zip")))
    assert sum(path.stat().st_size for path in FOLDER.glob("**/*") if path.is_file()) < 20e6


@pytest.mark.parametrize("path", AGENTS, ids=lambda path: "-".join(path.split("/")[-4:-1]))
def test_an_agent_plays_as_it_did_when_it_was_kept(path):
    """Its error in the first dev episode is that of its last evaluation; rounding may turn a close choice."""
    folder, agent = FOLDER.joinpath(*path.split("/")[-4:-1]), load_policy(path)
    asked = json.loads((folder / "config.json").read_text())
    assert agent.name == f"{asked['algo']}_{folder.name}" and folder.parts[-2] == asked["algo"]
    assert folder.parts[-3] == asked["env"].replace("/", "-") and asked["kwargs"] == {}
    kept = np.load(folder / "evaluations.npz")
    assert kept["steps"][0] == 0 and kept["steps"][-1] >= asked["config"]["total_steps"]
    assert len((folder / "monitor.csv").read_text().splitlines()) > 100
    error = play(asked["env"], {}, path, FIRST, "reduced")["error"]
    np.testing.assert_allclose(error, kept["errors"][-1][0], rtol=0.02)
