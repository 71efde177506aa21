"""Third-party worlds, registered by a script or by the entry points of a package."""

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

from short import FAST, register_apart

ID = "mine/Quiet-v0"


@dataclass(frozen=True)
class Never:
    """Third-party arrivals: without slugs."""

    def draw(self, random: np.random.Generator, begin: float, end: float) -> np.ndarray:
        return np.empty(0)


QUIET = replace(PIPE_2D.with_changes(FAST), name="Quiet", target=Slugs(arrivals=Never()))
OTHER = QUIET.with_changes({"schedule": {"scored_steps": 6}})
PACKAGE = '''
from eitbench import World, register
from eitbench.worlds.flows import LaminarFlow
from eitbench.worlds.slugs import Slugs
from eitbench.worlds.vessels import PlanePipe

register(World("Theirs", PlanePipe(length=0.3), LaminarFlow(), Slugs()), "theirs/Pipe-v3", lag=2,
         description="A shorter pipe.", test_seeds="test:0-3")
'''


@pytest.fixture(autouse=True)
def restored(monkeypatch):
    register_apart(monkeypatch)
    before = set(gym.registry)
    yield
    for id in set(gym.registry) - before:
        del gym.registry[id]


def hands() -> list[str]:
    return [each.id for each in registry.runtime_entries()]


def test_a_world_runs_under_its_id():
    """`gymnasium.make` works; in a pipe without slugs the background is the truth."""
    register(QUIET, ID, description="Nothing happens.", lag=1)
    assert list(entries())[-1] == ID
    assert entry(ID) == registry.Entry(ID, QUIET, "estimation", {"lag": 1}, "Nothing happens.")
    env = gym.make(ID)
    base = env.unwrapped
    assert base.world is QUIET and base.lag == 1
    env.reset(seed=3)
    rewards = [env.step(np.full(base.n_nodes, 30.0))[1] for _ in range(QUIET.n_steps + 1)]
    np.testing.assert_allclose(rewards, 0.0, atol=1e-9)
    env.reset(seed=3)
    rewards = [env.step(np.full(base.n_nodes, 33.0))[1] for _ in range(QUIET.n_steps + 1)]
    np.testing.assert_allclose(rewards, [0.0] * 3 + [-0.01] * 3, atol=1e-9)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.world is QUIET
    assert "Nothing happens." in eitbench.describe_environment(ID)
    assert "| `target.arrivals` | Never |" in eitbench.describe_environment(ID)


def test_an_id_belongs_to_one_world():
    """Equal registrations are accepted; another world, track, setting or text under the id is rejected."""
    register(QUIET, ID, lag=1)
    register(replace(QUIET), ID, lag=1)
    for world, settings in ((OTHER, {"lag": 1}), (QUIET, {}), (QUIET, {"lag": 1, "description": "!"}),
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


@pytest.mark.parametrize(("id", "settings", "message"), [
    *((id, {}, "id must look like 'namespace/Name-v0', got") for id in ("Quiet-v0", "mine/Quiet", "mine/a/Quiet-v0")),
    (ID, {"gate": 3.0}, "settings of the track estimation must be among lag, assume; got gate"),
    (ID, {"track": "injection", "lag": 3, "assume": {}},
     "settings of the track injection must be among gate, inflow, faults, history; got assume, lag"),
    (ID, {"track": "guessing"}, "track must be one of estimation, injection; got 'guessing'"),
    (ID, {"assume": {"mean_velocity": {1.0}}}, "not JSON"),
    (ID, {"group": "mine"}, r"group must be one of thesis examples, .*; got 'mine'")])
def test_a_rejected_registration_has_no_effect(id, settings, message):
    """Ids have one form, and each track has its settings."""
    with pytest.raises(ValueError, match=message):
        register(QUIET, id, **settings)
    assert id not in entries() and id not in gym.registry and not hands()


def test_the_last_registration_is_used():
    """A process that works for several scripts uses the registration of the current one."""
    register(QUIET, ID)
    registry.import_entries([replace(entry(ID), world=OTHER, settings={"lag": 2})])
    env = gym.make(ID).unwrapped
    assert env.world is entry(ID).world is OTHER and env.lag == 2


def test_modules_of_entry_points_are_imported(monkeypatch, tmp_path):
    """A package that raises is omitted with a warning; the others are registered, and not as entries of a script."""
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
    assert (theirs.settings, theirs.test_seeds) == ({"lag": 2}, "test:0-3")
    assert not hands()


@pytest.mark.parametrize("id", [id for id, each in entries().items() if each.nominal])
def test_a_variant_is_the_environment_of_its_id(id):
    """The world is the same object; the nominal id alone gives the nominal world."""
    each = entry(id)
    env = gym.make(each.nominal, variant=each.variant).unwrapped
    other = gym.make(id).unwrapped
    assert env.world is other.world is each.world and env.lag == other.lag
    assert gym.make(each.nominal).unwrapped.world is PIPE_2D
    many = gym.make_vec(each.nominal, num_envs=1, variant=each.variant)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert many.unwrapped.world is again.unwrapped.world is each.world


@pytest.mark.parametrize(("id", "variant", "message"), [
    ("eitbench/Pipe2D-v0", "strong-slug", r"variant of .*Pipe2D-v0 must be one of short-slugs, strong-slugs, .*; "
     r"got 'strong-slug'. Did you mean strong-slugs\?"),
    ("eitbench/Pipe3D-v0", "strong-slugs", "eitbench/Pipe3D-v0 has no variants, got 'strong-slugs'")])
def test_an_unknown_variant_is_rejected(id, variant, message):
    """The message lists the variants."""
    with pytest.raises(ValueError, match=message):
        gym.make(id, variant=variant)


def test_names_of_third_party_variants():
    """A variant is named after its id; a built-in name is not replaced."""
    register(PIPE_2D.with_changes({"instrument": {"noise_mismatch": 3.0}}), "mine/Pipe2DTripleNoise-v0",
             nominal="eitbench/Pipe2D-v0")
    register(PIPE_2D, "mine/Pipe2DStrongSlugs-v0", nominal="eitbench/Pipe2D-v0")
    assert entry("eitbench/Pipe2D-v0", "triple-noise").id == "mine/Pipe2DTripleNoise-v0"
    assert entry("eitbench/Pipe2D-v0", "strong-slugs").id == "eitbench/Pipe2DStrongSlugs-v0"
