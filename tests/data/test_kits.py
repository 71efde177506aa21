"""What is shipped for playing: it is what would be made, belongs to its numbers, and is believed only if sound."""

import gymnasium as gym
import numpy as np
import pytest
from eitbench.bench import kits as shipped
from eitbench.bench.tracks import own_ids
from eitbench.data import episodes, kits, store
from eitbench.worlds import entry

WANTED = shipped.wanted(own_ids())
CHEAP = {kits.kit_path(name, numbers(entry(id).world)).name
         for id in ("eitbench/Pipe2D-v0", "eitbench/StationaryTank2D-v0")
         for name, numbers in (("outline", kits.outline_numbers), ("beginning", kits.beginning_numbers))}


def marked(kit):
    return pytest.param(kit, id=kit.path.name, marks=[] if kit.path.name in CHEAP else [pytest.mark.slow])


def test_all_that_our_worlds_need_is_shipped_and_nothing_else():
    assert {kit.path.name for kit in WANTED} == {path.name for path in kits.KITS.iterdir()}
    for kit in WANTED:
        assert store.load(kit.path, kit.entries, kit.name) is not None, kit.path
    assert sum(kit.path.stat().st_size for kit in WANTED) < 5.5e6


@pytest.mark.parametrize("kit", [marked(kit) for kit in WANTED])
def test_shipped_is_what_would_be_made(kit):
    assert shipped.difference(kit) == ""


def test_models_are_compared_in_one_basis():
    """Turned by a rotation it is the same model; with another number it is not."""
    kit = next(kit for kit in WANTED if kit.name == "reduced")
    there = store.load(kit.path, kit.entries, kit.name)
    full = shipped.unpacked(there)
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(120, 120)))
    turned = {"basis": full["basis"] @ turn, **{name: turn.T @ full[name] @ turn
                                                for name in ("transition", "noise", "initial")}}
    again = shipped.packed(shipped.ReducedModel(**turned))
    assert shipped.difference_of(there, again) == ""
    again["noise"] = 1.001 * again["noise"]
    assert "noise" in shipped.difference_of(there, again)


@pytest.mark.parametrize(("numbers", "same", "other"), [
    (kits.outline_numbers,
     [{"flow": {"mean_velocity": 4.0}}, {"instrument": {"noise_relative": 0.1}}, {"region": None},
      {"instrument": {"contact_spread": 0.5, "untold_noise": 2.0}}, {"target": {"reach": [0.0, 0.5]}}],
     [{"vessel": {"electrodes_per_wall": 4}}, {"prior": {"expected_concentration": 24.0}},
      {"instrument": {"current": 0.2}}]),
    (kits.region_numbers,
     [{"schedule": {"scored_steps": 3}}], [{"region": [0.1, 0.2]}, {"vessel": {"electrodes_per_wall": 4}}]),
    (kits.model_numbers, [{"schedule": {"budget": 3, "scored_steps": 9}}, {"instrument": {"dead": [1, 1]}}],
     [{"instrument": {"noise_relative": 0.1}}, {"prior": {"nodal_std": 0.1}}, {"flow": {"mean_velocity": 4.0}},
      {"schedule": {"time_step": 4e-3}}, {"vessel": {"electrodes_per_wall": 4}}])])
def test_a_kit_belongs_to_its_numbers(numbers, same, other):
    """What it does not depend on may differ; nothing else."""
    world = entry("eitbench/Pipe2DInjectionFlow-v0").world
    path = kits.kit_path("it", numbers(world))
    assert all(kits.kit_path("it", numbers(world.changed(change))) == path for change in same)
    assert all(kits.kit_path("it", numbers(world.changed(change))) != path for change in other)


@pytest.mark.parametrize("id", [id for id in own_ids() if not entry(id).home])
def test_the_first_reset_simulates_nothing(id, monkeypatch, tmp_path):
    """Nor does it for a score: the first episode's beginning is shipped, of all but shifts, which are small."""
    monkeypatch.setenv(store.CACHE_VARIABLE, str(tmp_path))
    monkeypatch.setattr(episodes, "truth_discretisation", None)
    kwargs = {"estimator": "none"} if entry(id).track == "injection" else {}
    env = gym.make(id, **kwargs)
    observation, _ = env.reset()
    assert observation["voltages"].any() or kwargs
    env.step(env.action_space.sample())
    assert not list(tmp_path.iterdir())


def test_damaged_kit_is_none(tmp_path, monkeypatch):
    """Its arrays are made, and kept in the cache; the cache is not looked at where there is a sound kit."""
    monkeypatch.setattr(kits, "KITS", tmp_path)
    numbers = {"a": 1}
    path = kits.kit_path("it", numbers)
    store.save(path, {"x": np.arange(3)}, "it", small=True)

    def loaded():
        place = tmp_path / "cache" / "it.npz"
        return kits.shipped_or_kept("it", numbers, lambda: place, ("x",), lambda: {"x": np.ones(2)})["x"]

    assert loaded().tolist() == [0, 1, 2] and not (tmp_path / "cache").exists()
    data = path.read_bytes()
    for damaged in (data[:-9], b"", data.replace(b"x.npy", b"y.npy")):
        path.write_bytes(damaged)
        assert loaded().tolist() == [1, 1]
    path.unlink()
    assert loaded().tolist() == [1, 1] and (tmp_path / "cache" / "it.npz").is_file()
