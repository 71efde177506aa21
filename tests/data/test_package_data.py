"""Shipped files equal newly built ones, and make the first reset possible without a simulation."""

import gymnasium as gym
import numpy as np
import pytest
from eitbench.bench.package_data import expected_files
from eitbench.bench.tracks import builtin_ids
from eitbench.data import cache, episodes
from eitbench.data.cache import load_shipped
from eitbench.data.episode_cache import csr_of, prefix_file, region_file, scoring_constants_file
from eitbench.estimation.onboard.models import model_file, unpack_model
from eitbench.worlds import entry

EXPECTED = expected_files(builtin_ids())
CHEAP = {file(entry("eitbench/Pipe2D-v0").world).key for file in (scoring_constants_file, prefix_file)}


def difference(shipped, built):
    """Describe the difference of arrays beyond 1e-5 of the largest entry, as models are in single precision. The basis
    of a model's space, and which entries of a matrix are rounded to zero, may depend on the processor."""
    if "indptr" in built:
        shipped, built = ({"mass": csr_of(arrays).toarray(), "largest": arrays.get("largest", np.zeros(1))}
                          for arrays in (shipped, built))
    assert shipped.keys() == built.keys()
    assert all(shipped[name].shape == array.shape and shipped[name].dtype == array.dtype
               for name, array in built.items())
    if "basis" in built:
        shipped, built = unpack_model(shipped), unpack_model(built)
        turn, *_ = np.linalg.lstsq(shipped["basis"], built["basis"])
        back = np.linalg.inv(turn)
        shipped |= {"basis": shipped["basis"] @ turn, "transition": back @ shipped["transition"] @ turn,
                    **{name: back @ shipped[name] @ back.T for name in ("noise", "initial")}}
    return [name for name, array in built.items()
            if not np.abs(shipped[name].astype(float) - array).max() <= 1e-5 * (np.abs(array).max() or 1.0)]


def test_exactly_the_needed_files_are_shipped():
    needed = {file.key.shipped_path.name for file in EXPECTED}
    assert {path.name for path in cache.PACKAGE_DATA.iterdir()} == needed
    for file in EXPECTED:
        assert load_shipped(file.key) is not None, file.key
    assert sum(file.key.shipped_path.stat().st_size for file in EXPECTED) < 3.9e6


@pytest.mark.parametrize("file", [
    pytest.param(file, id=file.key.name, marks=[] if file.key in CHEAP else [pytest.mark.slow])
    for file in EXPECTED])
def test_shipped_is_what_would_be_built(file):
    assert not difference(load_shipped(file.key), file.build())


@pytest.mark.parametrize(("key", "same", "other"), [
    (cache.folder,
     [{"instrument": {"noise_relative": 0.05, "n_dead_range": [1, 1]}}, {"prior": {"inflow_std": 0.5}},
      {"schedule": {"budget": 2}}],
     [{"vessel": {"contact_impedance": 1e-3}}, {"flow": {"diffusivity": 1e-3}}, {"region": [0.1, 0.2]},
      {"target": {"arrivals": {"interval": 0.021}}}, {"schedule": {"pattern": {"frame": 3}}},
      {"instrument": {"current": 0.2}}, {"prior": {"expected_concentration": 24.0}}]),
    (lambda world: scoring_constants_file(world).key,
     [{"flow": {"mean_velocity": 4.0}}, {"instrument": {"noise_relative": 0.1}}, {"region": None},
      {"instrument": {"contact_impedance_spread": 0.5, "noise_mismatch": 2.0}},
      {"target": {"radial_range": [0.0, 0.5]}}],
     [{"vessel": {"electrodes_per_wall": 4}}, {"prior": {"expected_concentration": 24.0}},
      {"instrument": {"current": 0.2}}]),
    (lambda world: region_file(world).key,
     [{"schedule": {"scored_steps": 3}}], [{"region": [0.1, 0.2]}, {"vessel": {"electrodes_per_wall": 4}}]),
    (lambda world: model_file(world).key,
     [{"schedule": {"budget": 3, "scored_steps": 9}}, {"instrument": {"n_dead_range": [1, 1]}}],
     [{"instrument": {"noise_relative": 0.1}}, {"prior": {"nodal_std": 0.1}}, {"flow": {"mean_velocity": 4.0}},
      {"schedule": {"time_step": 4e-3}}, {"vessel": {"electrodes_per_wall": 4}}])])
def test_a_file_belongs_to_its_numbers(key, same, other):
    """Files are loaded for any value of parameters on which they do not depend, and not for others. The digest in
    records depends on all of them."""
    world = entry("eitbench/Pipe2DInjectionFlow-v0").world
    worlds = [world, *map(world.with_changes, same), *map(world.with_changes, other)]
    assert all(key(each) == key(world) for each in worlds[:1 + len(same)])
    assert len({key(each) for each in worlds[len(same):]}) == 1 + len(other)
    assert len({cache.world_digest(each) for each in worlds}) == len(worlds)


@pytest.mark.parametrize("id", [id for id in builtin_ids() if entry(id).world.warm_up])
def test_the_first_reset_simulates_nothing(id, monkeypatch, tmp_path):
    monkeypatch.setenv(cache.CACHE_VARIABLE, str(tmp_path))
    monkeypatch.setattr(episodes, "cached_truth_model", None)
    kwargs = {"estimator": "none"} if entry(id).track == "injection" else {}
    env = gym.make(id, **kwargs)
    observation, _ = env.reset()
    assert observation["voltages"].any() or kwargs
    env.step(env.action_space.sample())
    assert not list(tmp_path.iterdir())
