"""`Task`: information for an estimator, without the ground truth."""

import functools
import gc
import types
from dataclasses import replace

import eitbench  # noqa: F401 (registers)
import numpy as np
import pytest
from eitbench.data.cache import CACHE_VARIABLE
from eitbench.data.episodes import Episode, cached_truth_model, simulate
from eitbench.envs.estimation import EstimationEnv
from eitbench.worlds import Flow, Target
from eitbench.worlds.catalogue import PIPE_2D
from eitbench.worlds.task import make_task
from eitbench.worlds.world import World

from injection_envs import play
from short import FAST, TINY, world


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_says_what_the_world_says():
    """Times, currents, noise and c_ref equal the world's."""
    task = make_task(TINY)
    assert (task.n_steps, task.warm_up, task.lag, task.expected_concentration) == (5, 2, 0, 25.0)
    np.testing.assert_array_equal(task.currents, TINY.currents)
    assert (task.noise, task.prior, task.vessel) == (TINY.noise, TINY.prior, TINY.vessel)
    # The expected concentration must not reveal the truth: as an estimate it would beat the homogeneous one.
    assert PIPE_2D.expected_concentration != PIPE_2D.background


def test_lag():
    """``lag`` is a number of steps within the episode, or "all": the first state is requested after the last
    measurement."""
    assert [make_task(TINY, lag).lag for lag in (0, np.int64(4), "all")] == [0, 4, 4]
    for wrong in (-1, 5, 1.5, True, "2"):
        with pytest.raises(ValueError, match=rf"lag must be .*integer.* 0 .* 4.*{wrong!r}"):
            make_task(TINY, wrong)


def test_assumed_velocity_changes_the_model_not_the_world(cache):
    """A wrong assumption changes the model's flow, not the episode and its voltages."""
    right, wrong = (EstimationEnv("eitbench/Pipe2D-v0", world=FAST, assume=assume)
                    for assume in (None, {"mean_velocity": 60.0}))
    rng = np.random.default_rng(2)
    c = rng.uniform(20.0, 40.0, 1701)
    moved = [env.task.transport.step(c, 30.0, 30.0) for env in (right, wrong)]
    assert np.abs(moved[0] - moved[1]).max() > 1.0
    silence = np.full((9, 1701), 30.0)
    np.testing.assert_equal(play(wrong, 3, silence), play(right, 3, silence))
    assert len(list(cache.rglob("*.truth.npy"))) == 1


def reachable(start):
    """Return all objects that can be reached from ``start`` by attributes, items, closures and caches."""
    found, waiting = {}, [start]
    while waiting:
        thing = waiting.pop()
        if id(thing) in found or isinstance(thing, (type, types.ModuleType, types.CodeType)):
            continue
        found[id(thing)] = thing
        if isinstance(thing, np.ndarray):
            waiting += [] if thing.base is None else [thing.base]
            waiting += list(thing.ravel()) if thing.dtype == object else []
        own = getattr(thing, "__globals__", None)    # a function's globals reach everything, so they are skipped
        waiting += [each for each in gc.get_referents(thing) if each is not own]
    return list(found.values())


def sizes(discretisation):
    """Return lengths of arrays on these meshes."""
    transport, observation = discretisation
    return {transport.mesh.n_nodes, len(transport.mesh.cells), len(observation.cem.mesh.points),
            len(observation.cem.mesh.cells), observation.cem.n_unknowns}


def traces_of_truth(given, world):
    """Return objects within ``given`` that reveal the truth: episodes, worlds, fine discretisations, large arrays."""
    truth = cached_truth_model(world)
    its_own = {id(thing) for thing in reachable(truth) if isinstance(thing, np.ndarray)}
    fine = sizes(truth)
    return [thing for thing in reachable(given)
            if isinstance(thing, (Episode, World, EstimationEnv)) or id(thing) in its_own
            or not {Flow, Target}.isdisjoint(type(thing).__mro__)
            or (isinstance(thing, np.ndarray) and not fine.isdisjoint({*thing.shape, thing.size}))]


@pytest.mark.parametrize("name", ["eitbench/Pipe2DSkewedVelocity-v0", "eitbench/RotatingTank2D-v0"])
def test_estimators_are_given_nothing_of_the_truth(name):
    """Task, observations and infos do not reveal the truth during an episode, or through caches and closures."""
    env = EstimationEnv(name, **world(name))
    assert sizes(cached_truth_model(env.world)).isdisjoint(sizes(env.world.estimator_model()))
    given, done = [env.task, env.reset(seed=3)], False
    while not done:
        *step, done, _, info = env.step(np.full(env.action_space.shape, 30.0))
        given += [step, info]
        assert traces_of_truth(given, env.world) == []
    assert len([thing for thing in reachable(env.task) if isinstance(thing, np.ndarray)]) > 20


def test_the_search_finds_what_is_hidden():
    """The search is effective: it finds a truth that is put into a task as an attribute or world, in a closure or
    container, and a model on the truth's mesh."""
    episode, fine = simulate(TINY, 3), cached_truth_model(TINY).observation
    for hidden in ({"noise": episode}, {"noise": lambda: episode}, {"noise": functools.partial(max, TINY)},
                   {"currents": [{"kept": (episode.concentration[1:],)}]}, {"observation": fine}):
        assert traces_of_truth(replace(make_task(TINY), **hidden), TINY), hidden


def test_wrong_belief_does_not_tell_the_right_one():
    """A task that assumes 60 m/s holds no number 45, nor a flow of that velocity."""
    task = make_task(TINY, mean_velocity=60.0)
    assert not [thing for thing in reachable(task) if isinstance(thing, (int, float)) and thing == 45.0]
