"""Built-in agents: checkpoints are complete, can be loaded, and reproduce their evaluations."""

import json
import shutil

import numpy as np
import pytest
from eitbench.bench import isolation
from eitbench.bench.methods import baseline_folder, builtin_agents, load_method
from eitbench.bench.run import Job, run_episode
from eitbench.bench.tracks import Environment, ids

from injection_envs import injected
from short import world

FOLDER = baseline_folder() / "checkpoints"
AGENTS = [path for env in ids("injection") for path in builtin_agents(env)]
REPRODUCED = ("eitbench-Pipe2DInjectionBudget-v0", "eitbench-TankTracking-v0")
FIRST = 100_000
"""The first dev episode, which every evaluation contains."""


def test_every_checkpoint_is_an_agent_of_an_environment():
    """All checkpoints are in the folders of registered environments, and their total size is small enough for git."""
    assert sorted(AGENTS) == sorted(map(str, FOLDER.glob("**/model.zip")))
    assert sum(path.stat().st_size for path in FOLDER.glob("**/*") if path.is_file()) < 35e6


@pytest.mark.parametrize("path", AGENTS, ids=lambda path: "-".join(path.split("/")[-4:-1]))
def test_agents_reproduce_their_evaluation(path):
    """The error in the first dev episode equals the last evaluation; rounding may change a close decision. Only
    the second training of two environments runs here; the golden files hold the first of each."""
    folder, agent = FOLDER.joinpath(*path.split("/")[-4:-1]), load_method(path, "injection")
    asked = json.loads((folder / "config.json").read_text())
    assert agent.name == f"{asked['algo']}_{folder.name}" and folder.parts[-2] == asked["algo"]
    assert folder.parts[-3] == asked["env"].replace("/", "-") and asked["kwargs"] == {}
    kept = np.load(folder / "evaluations.npz")
    assert kept["timesteps"][0] == 0 and kept["timesteps"][-1] >= asked["config"]["total_steps"]
    if folder.name != "seed1" or folder.parts[-3] not in REPRODUCED:
        return
    error = injected(asked["env"], {}, path, FIRST, "reduced").errors.mean()
    np.testing.assert_allclose(error, kept["errors"][-1][0], rtol=0.02)


@pytest.mark.skipif(not AGENTS, reason="needs the extra rl")
def test_a_copied_agent_runs_in_a_worker(tmp_path):
    """A copy elsewhere, unpickled in a separate process, has the same results as in this process."""
    folder = shutil.copytree(FOLDER.joinpath(*AGENTS[0].split("/")[-4:-1]), tmp_path / "theirs")
    asked = json.loads((folder / "config.json").read_text())
    kwargs = world(asked["env"]) | {"estimator": "reduced"}
    job = Job(Environment(asked["env"], json.dumps(kwargs)), str(folder / "model.zip"), FIRST)
    try:
        here, there = (run_episode(job._replace(isolation=kind))[0] for kind in ("none", "process"))
    finally:
        isolation.close()
    assert here["method"] == there["method"] == f"{asked['algo']}_seed{asked['seed']}"          # a copy is built-in
    assert here["status"] == "ok" and here["step_errors"] == there["step_errors"]
    assert here["checkpoint_sha256"] == there["checkpoint_sha256"] and there["peak_memory"] > 50e6
