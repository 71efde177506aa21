"""Worlds that others register: by hand, or in a package that says so when it is installed."""

import pickle
import subprocess
import sys
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint

import eitbench
import gymnasium as gym
import numpy as np
import pytest
from eitbench.worlds import entries, entry, register, registry
from eitbench.worlds.catalogue import PIPE_2D
from eitbench.worlds.slugs import Slugs

from short import PIPE, register_apart

ID = "mine/Quiet-v0"


@dataclass(frozen=True)
class Never:
    """Arrivals of a user of tomorrow: no slug comes."""

    def draw(self, random: np.random.Generator, begin: float, end: float) -> np.ndarray:
        return np.empty(0)


QUIET = replace(PIPE_2D.changed(PIPE), name="Quiet", target=Slugs(arrivals=Never()))
OTHER = QUIET.changed({"schedule": {"scored_steps": 6}})
PACKAGE = '''
from eitbench import World, register
from eitbench.worlds.flows import LaminarFlow
from eitbench.worlds.slugs import Slugs
from eitbench.worlds.vessels import PlanePipe

register(World("Theirs", PlanePipe(length=0.3), LaminarFlow(), Slugs()), "theirs/Pipe-v3", lag=2,
         about="A shorter pipe.", seeds="test:0-3")
'''


@pytest.fixture(autouse=True)
def restored(monkeypatch):
    """What is registered by a test is forgotten after it."""
    register_apart(monkeypatch)
    before = set(gym.registry)
    yield
    for id in set(gym.registry) - before:
        del gym.registry[id]


def hands() -> list[str]:
    """Ids registered by hand."""
    return [each.id for each in registry.registered_by_hand()]


def test_a_world_is_played_under_its_id():
    """By gymnasium's own `make`; in a pipe into which nothing comes the background is the truth."""
    register(QUIET, ID, about="Nothing happens.", lag=1)
    assert list(entries())[-1] == ID
    assert entry(ID) == registry.Entry(ID, QUIET, "estimation", {"lag": 1}, "Nothing happens.")
    env = gym.make(ID)
    base = env.unwrapped
    assert base.world is QUIET
    assert base.lag == 1
    env.reset(seed=3)
    rewards = [env.step(np.full(base.n_nodes, 30.0))[1] for _ in range(QUIET.n_steps + 1)]
    np.testing.assert_allclose(rewards, 0.0, atol=1e-9)
    env.reset(seed=3)
    rewards = [env.step(np.full(base.n_nodes, 33.0))[1] for _ in range(QUIET.n_steps + 1)]
    np.testing.assert_allclose(rewards, [0.0] * 3 + [-0.01] * 5, atol=1e-9)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.world is QUIET
    assert "Nothing happens." in eitbench.describe_environment(ID)
    assert "| `target.arrivals` | Never |" in eitbench.describe_environment(ID)


def test_an_id_belongs_to_one_world():
    """The same again is nothing new; another world, track, setting or text under it is refused."""
    register(QUIET, ID, lag=1)
    register(replace(QUIET), ID, lag=1)
    for world, settings in ((OTHER, {"lag": 1}), (QUIET, {}), (QUIET, {"lag": 1, "about": "!"}),
                            (QUIET, {"track": "injection"})):
        with pytest.raises(ValueError, match=f"id {ID} belongs to another world already"):
            register(world, ID, **settings)
    gym.register("theirs/CartPole-v7", entry_point="gymnasium.envs.classic_control:CartPoleEnv")
    for theirs in ("eitbench/Pipe2D-v0", "theirs/CartPole-v7"):
        with pytest.raises(ValueError, match=f"{theirs} belongs to another world already"):
            register(QUIET, theirs)
    assert entry(ID).world == QUIET
    assert entry("eitbench/Pipe2D-v0").world is PIPE_2D
    register(OTHER, "mine/Quiet-v1", lag=1)
    assert hands() == [ID, "mine/Quiet-v1"]


@pytest.mark.parametrize("id", ["Quiet-v0", "mine/Quiet", "mine/a/Quiet-v0", "mine/Quiet-v0 ", ""])
def test_ids_of_another_form_are_refused(id):
    """Before anything is registered."""
    with pytest.raises(ValueError, match="id must look like 'namespace/Name-v0', got"):
        register(QUIET, id)
    assert id not in entries()
    assert not hands()


@pytest.mark.parametrize(("settings", "message"), [
    ({"gate": 3.0}, "settings of the track estimation must be among lag, assume; got gate"),
    ({"track": "injection", "lag": 3, "assume": {}}, "injection must be among gate, inflow; got assume, lag"),
    ({"track": "guessing"}, "track must be one of estimation, injection, got 'guessing'"),
    ({"assume": {"mean_velocity": {1.0}}}, "not JSON"),
])
def test_settings_of_another_track_are_refused(settings, message):
    """Each track has its own; what is refused leaves nothing behind."""
    with pytest.raises(ValueError, match=message):
        register(QUIET, ID, **settings)
    assert ID not in entries()
    assert ID not in gym.registry


def test_an_id_that_nobody_registered_is_named():
    """With those that there are."""
    with pytest.raises(ValueError, match=r"env must be one of eitbench/Pipe2D-v0, .*; got 'mine/"):
        entry(ID)


def test_another_process_takes_over(tmp_path):
    """What was registered by hand here is played there, with the same bits."""
    world = PIPE_2D.changed(PIPE)
    register(world, ID, lag=2, about="Mine.", seeds="test:0-2")
    told = tmp_path / "told"
    told.write_bytes(pickle.dumps(registry.registered_by_hand()))
    code = ("import pathlib, pickle, sys\n"
            "import gymnasium as gym\n"
            "from eitbench.worlds import entry, registry\n"
            f"told = pickle.loads(pathlib.Path({str(told)!r}).read_bytes())\n"
            "for _ in range(2):\n"
            "    registry.take_over(told)\n"
            "assert entry(told[0].id) == told[0]\n"
            "env = gym.make(told[0].id)\n"
            "assert env.unwrapped.lag == 2\n"
            "print(env.reset(seed=1)[0]['voltages'].tobytes().hex())")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    here = gym.make(ID).reset(seed=1)[0]["voltages"]
    assert done.stdout.strip() == here.tobytes().hex()


def test_who_is_told_last_counts():
    """A process that works for one script after another plays what the present one means."""
    register(QUIET, ID)
    registry.take_over([replace(entry(ID), world=OTHER, settings={"lag": 2})])
    assert entry(ID).world == OTHER
    env = gym.make(ID).unwrapped
    assert env.world is OTHER
    assert env.lag == 2


def test_modules_of_entry_points_are_imported(monkeypatch, tmp_path):
    """One that raises is left out with a warning; the others are there, and not as if by hand."""
    (tmp_path / "their_worlds.py").write_text(PACKAGE)
    (tmp_path / "broken_worlds.py").write_text("raise RuntimeError('out of order')\n")
    monkeypatch.syspath_prepend(tmp_path)
    asked = []

    def points(*, group: str) -> list[EntryPoint]:
        asked.append(group)
        modules = ["broken_worlds", "missing_worlds", "their_worlds"]
        return [EntryPoint(name, name, group) for name in modules]

    monkeypatch.setattr(registry, "entry_points", points)
    with pytest.warns(UserWarning, match="worlds of") as caught:
        registry.register_installed()
    for name in ("their_worlds", "broken_worlds"):
        sys.modules.pop(name, None)
    assert asked == ["eitbench.worlds"]
    assert [str(each.message) for each in caught] == [
        "worlds of broken_worlds are left out: RuntimeError: out of order",
        "worlds of missing_worlds are left out: ModuleNotFoundError: No module named "
        "'missing_worlds'"]
    theirs = entry("theirs/Pipe-v3")
    assert theirs.world.vessel.length == 0.3
    assert (theirs.settings, theirs.seeds) == ({"lag": 2}, "test:0-3")
    assert not hands()
