"""Presimulation: missing episodes are simulated, bit-identical to single ones, and finished ones are kept. The
sampler: unseeded resets draw few episodes at first, independent of the cache."""

import re
import shutil
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from eitbench.data import cache, presimulation
from eitbench.data.cache import CACHE_VARIABLE, folder
from eitbench.data.episode_cache import build_cached_episode, cached_episode, is_episode_cached
from eitbench.data.episodes import simulate
from eitbench.data.presimulation import MAX_EPISODES, EpisodeSampler, cached_episode_bytes, presimulate
from eitbench.worlds import entry
from eitbench.worlds.catalogue import PIPE_2D, PIPE_2D_DRIFTING
from joblib.externals.loky import get_reusable_executor

from commands import eitbench as command
from recorded import forget
from short import DRAWN, PLAIN, TINY, shorten

SEEDS = range(4)
"""A full batch of `small_batches` and a remainder."""


@pytest.fixture(autouse=True)
def place(place, monkeypatch):
    """Give ids of the plain pipe the tiny world, and the test a cache folder."""
    shorten(monkeypatch, *(id for id in PLAIN if entry(id).track == "estimation"))
    return folder(TINY)


@pytest.fixture
def small_batches(monkeypatch):
    monkeypatch.setattr(presimulation, "BATCH_SIZE", 3)


@pytest.fixture(scope="module")
def alone():
    """Return the bytes of each cached episode, simulated alone."""
    return {seed: build_cached_episode(TINY, simulate(TINY, seed, cache=False)).tobytes() for seed in SEEDS}


def stamps(place):
    return {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in place.iterdir()}


def test_recordings_have_the_bits_of_those_made_alone(place, alone, monkeypatch, tmp_path):
    """Each cached episode belongs to its seed, and truths are not stored; if $EITBENCH_CACHE changes, existing workers
    use the new folder."""
    get_reusable_executor().shutdown(wait=True)      # workers keep their initial cache folder
    assert presimulate(TINY, SEEDS, n_jobs=2) == 4
    assert stamps(place).keys() == {f"{seed}.npy" for seed in SEEDS}
    monkeypatch.setattr("eitbench.data.episode_cache.simulate", None)               # all are cached
    assert {seed: cached_episode(TINY, seed).tobytes() for seed in SEEDS} == alone
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "other"))
    forget()
    assert presimulate(TINY, [0, 1], n_jobs=2) == 2
    assert is_episode_cached(TINY, 0) and is_episode_cached(TINY, 1)


def test_only_what_is_missing_is_made(place, asked, alone, small_batches):
    """Batches have a limited size; duplicate seeds are simulated once, a damaged file counts as missing."""
    cached_episode(TINY, 2)
    (place / "2.truth.npy").unlink()
    assert presimulate(TINY, [4, 2, 1, 4]) == 2 and asked == [[4, 1]]
    before = stamps(place)
    assert before.keys() == {"1.npy", "2.npy", "4.npy"}
    assert presimulate(TINY, [1, 2, 4]) == presimulate(TINY, []) == 0 and len(asked) == 1
    assert presimulate(TINY, range(7)) == 4 and asked[1:] == [[0, 3, 5], [6]]
    assert {name: stamps(place)[name] for name in before} == before
    path = cache.episode_key(TINY, 1).path
    path.write_bytes(path.read_bytes()[:-1])
    assert presimulate(TINY, range(7)) == 1 and asked[3:] == [[1]]
    assert {seed: cached_episode(TINY, seed).tobytes() for seed in SEEDS} == alone


def test_interrupted_fill_keeps_what_is_done_and_resumes(place, asked, alone, small_batches, monkeypatch):
    """After Ctrl-C at the third episode, two are cached and valid, and the next call simulates the other two."""
    real = cache.store

    def interrupted(key, arrays):
        if len(stamps(place)) == 2:
            raise KeyboardInterrupt
        real(key, arrays)

    place.mkdir(parents=True)
    with monkeypatch.context() as patch:
        patch.setattr(cache, "store", interrupted)
        with pytest.raises(KeyboardInterrupt):
            presimulate(TINY, SEEDS)
    forget()
    assert [seed for seed in SEEDS if is_episode_cached(TINY, seed)] == [0, 1]
    before = stamps(place)
    assert presimulate(TINY, SEEDS) == 2 and asked[1] == [2, 3]
    assert {name: stamp for name, stamp in stamps(place).items() if name in before} == before
    assert {seed: cached_episode(TINY, seed).tobytes() for seed in SEEDS} == alone


def test_predicted_size_is_that_of_the_files():
    """The estimated size is accurate to 1 %, with integrals over a region."""
    region = PIPE_2D_DRIFTING.with_changes(DRAWN)
    presimulate(region, [0])
    size = cache.episode_key(region, 0).path.stat().st_size
    assert size == pytest.approx(cached_episode_bytes(region), rel=0.01)
    assert cached_episode_bytes(PIPE_2D) == pytest.approx(881_000, rel=0.01)


def test_command_fills_and_resumes(place, asked, alone):
    """The command prints the numbers of new and cached episodes, and environments find them; dev:0 is not train:0."""
    code, said, _ = command("bank", "--seeds", "train:0-2", "-j", "1")
    assert code == 0
    assert "3 simulated, 0 were already stored" in said
    assert f"3 episodes, 0 MB in {place}" in said
    code, said, _ = command("bank", "--seeds", "train:0-3", "-j", "1", "--env", "eitbench/Pipe2DSmoothing-v0")
    assert code == 0 and "1 simulated, 3 were already stored" in said and asked == [[0, 1, 2], [3]]
    assert {seed: cached_episode(TINY, seed).tobytes() for seed in SEEDS} == alone
    assert command("bank", "--seeds", "dev:0", "-j", "1")[0] == 0 and asked[2:] == [[100_000]]


def test_full_disk_is_refused_before_anything_is_simulated(place, asked, monkeypatch):
    """One byte too few leads to exit code 2 and the required size; with enough it runs, and cached episodes
    need no space."""
    free = [cached_episode_bytes(TINY) - 1]
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free[0]))
    code, said, complaint = command("bank", "--seeds", "train:0", "-j", "1")
    assert code == 2 and re.search("seeds need .* are free", complaint) and "simulated" not in said
    assert asked == [] and not stamps(place)
    free[0] += 1
    for seeds, made in (("train:0", [0]), ("train:0-1", [1])):
        assert command("bank", "--seeds", seeds, "-j", "1")[0] == 0 and asked[-1] == made


def test_pool_grows_with_the_resets():
    """The sampler has 1, 8, 16, … up to 1000 episodes; PPO with 20,000 steps draws from eight."""
    random, drawn, found = np.random.default_rng(0), EpisodeSampler(None), []
    for _ in range(9000):
        found.append(drawn.size)
        assert 0 <= drawn.sample_seed(random) < found[-1]
    assert found[:4] == [1] * 4 and set(found[4:128]) == {8} and set(found[128:256]) == {16}
    changes = [k for k in range(1, 9000) if found[k] != found[k - 1]]
    assert changes == [4] + [8 * 2**k for k in range(4, 10)] + [8 * 1024]
    assert found[-1] == MAX_EPISODES == max(found)
    drawn.reset()                                  # after a seeded reset
    assert drawn.size == 1


def test_the_sequence_depends_on_the_seed_alone():
    """Draws do not depend on the cache."""
    def seen():
        env = gym.make("eitbench/Pipe2D-v0")
        env.reset(seed=1)
        return [env.reset()[0] for _ in range(8)]

    first = seen()
    presimulate(TINY, SEEDS)
    np.testing.assert_equal(seen(), first)
