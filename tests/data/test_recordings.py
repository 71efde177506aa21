"""Recordings: they score as the truth does, they are bit for bit the simulation's, and damage is
never believed."""

import hashlib
import os
import subprocess
import sys
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import scipy.sparse as sp
from tiny_worlds import CHANGES, TINY

import eitbench  # noqa: F401 (registers)
from eitbench.data import episodes, recordings, store
from eitbench.data.episodes import simulate, truth_discretisation
from eitbench.data.recordings import (
    SPARSE,
    cycle_voltages,
    faults_of,
    is_recorded,
    outline,
    recording,
    recording_path,
    sparse_of,
    step_error,
)
from eitbench.data.store import CACHE_VARIABLE, folder
from eitbench.worlds.pipe2d import PIPE_2D

HEADER = 256
"""Bytes before the first step of a recording of TINY."""


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache folder of its own for each test, as a process finds it that has seen nothing yet."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    forget()
    yield tmp_path / "cache"
    forget()


def forget():
    """What a new process does not know: files found in order, and outlines."""
    recordings._sound.clear()
    recordings._outline.cache_clear()


@pytest.fixture(scope="module")
def episode():
    """Seed 7, simulated without a cache."""
    return simulate(TINY, 7, cache=False)


@pytest.fixture
def counted(monkeypatch, episode):
    """`simulate` replaced by one that returns seed 7 at once and counts its calls."""
    calls = []
    monkeypatch.setattr(recordings, "simulate", lambda *arguments: calls.append(arguments)
                        or episode)
    return SimpleNamespace(bits=bits(recordings.make_recording(TINY, 7, episode)), calls=calls)


def bits(entries):
    """All that makes two recordings the same."""
    return entries.dtype, entries.shape, entries.tobytes()


def outline_bits(stage):
    """All that makes two outlines the same."""
    mass = stage.mass
    return [(array.dtype.str, array.tobytes())
            for array in (mass.data, mass.indices, mass.indptr)] + [
        mass.shape, stage.largest_voltage]


def digest(entries, stage):
    """Of a recording and an outline, to be compared between processes."""
    mass = stage.mass
    parts = [entries, mass.data, mass.indices, mass.indptr, np.array(stage.largest_voltage)]
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


# -- independent integrals -------------------------------------------------------------------------


def values_at(points, mesh):
    """Dense matrix from nodal values on ``mesh`` to values at ``points``: every point is looked for
    in every cell."""
    matrix, found = np.zeros((len(points), mesh.n_nodes)), np.zeros(len(points), dtype=bool)
    homogeneous = np.column_stack([points, np.ones(len(points))])
    for cell in mesh.cells:
        weights = homogeneous @ np.linalg.inv(np.column_stack([mesh.points[cell], np.ones(3)]))
        inside = (weights > -1e-9).all(axis=1) & ~found
        matrix[np.ix_(inside, cell)] = weights[inside]
        found |= inside
    assert found.all()
    return matrix


def integral_of_square(mesh, nodal):
    """∫f² for nodal values (..., n): the three midpoints of a triangle's edges integrate a
    quadratic exactly."""
    corner = nodal[..., mesh.cells]
    middles = 0.5 * (corner + np.roll(corner, 1, axis=-1))
    edges = mesh.points[mesh.cells[:, 1:]] - mesh.points[mesh.cells[:, :1]]
    area = 0.5 * np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
    return (middles**2).mean(axis=-1) @ area


@pytest.fixture(scope="module")
def to_truth():
    """Interpolation from the model's nodes to the truth's, dense."""
    return values_at(truth_discretisation(TINY).transport.mesh.points, TINY.model().transport.mesh)


@pytest.mark.parametrize("kind", ["near the truth", "good", "bad", "constant", "background"])
def test_score_is_the_integral_over_the_truth(kind, episode, to_truth):
    """The step error from moments equals ∫(ĉ − c)²/∫c² taken over the truth's own triangles,
    whatever the estimate.

    To 1e-6 of it, but for 3e-10 that single precision of the moments costs (measured: 6e-11).
    """
    exactly = {"rtol": 1e-6, "atol": 3e-10}
    mesh, nodes = truth_discretisation(TINY).transport.mesh, TINY.model().transport.mesh.points
    truth = episode.concentration[1:].astype(float)
    nearest, rng = truth @ mesh.interpolation_to(nodes).T, np.random.default_rng(1)
    estimate = {"near the truth": nearest,
                "good": nearest + rng.normal(size=(5, 1)) + rng.normal(size=(5, len(nodes))),
                "bad": rng.uniform(-250.0, 250.0, (5, len(nodes))),
                "constant": np.full((5, len(nodes)), 25.0),
                "background": np.full((5, len(nodes)), TINY.background)}[kind]
    exact = integral_of_square(mesh, estimate @ to_truth.T - truth) / integral_of_square(mesh,
                                                                                         truth)
    if kind == "near the truth":
        assert exact.max() < 1e-4                   # what the coarser mesh cannot hold, and no more
    entries, mass = recording(TINY, 7), outline(TINY).mass
    scored = step_error(mass, estimate - TINY.background, entries["moment"], entries["deviation"],
                        entries["square"])
    np.testing.assert_allclose(scored, exact, **exactly)
    for t in range(5):                                 # one step at a time, as the environment asks
        one = step_error(mass, estimate[t] - TINY.background, entries["moment"][t],
                         entries["deviation"][t], entries["square"][t])
        np.testing.assert_allclose(one, exact[t], **exactly)


def test_outline_holds_one_triangle_of_the_mass_on_the_estimators_nodes(to_truth):
    """xᵀ·mass·x = ∫(Px)² over the truth's triangles for any x, and nothing is stored below the
    diagonal."""
    mass, mesh = outline(TINY).mass, truth_discretisation(TINY).transport.mesh
    assert mass.shape == (1701, 1701) and sp.tril(mass, -1).nnz == 0 and sp.triu(mass, 1).nnz > 1701
    for x in np.random.default_rng(2).normal(size=(5, 1701)):
        assert x @ (mass @ x) == pytest.approx(integral_of_square(mesh, to_truth @ x), rel=1e-12)


def test_outline_knows_the_largest_voltage():
    """That of the whole injection cycle into liquid of the expected concentration."""
    observation, level = TINY.model().observation, np.full(1701, TINY.expected_concentration)
    largest = max(np.abs(observation.transfer_resistance(level) @ currents).max()
                  for currents in TINY.currents)
    assert outline(TINY).largest_voltage == pytest.approx(largest, rel=1e-10)


# -- the simulation, bit for bit -------------------------------------------------------------------


def test_resistances_and_noise_are_those_of_the_episode(episode):
    """Nothing is rounded of what makes the voltages."""
    entries = recording(TINY, 7)
    assert entries.shape == (5,) and entries["moment"].shape == (5, 1701)
    for name in ("transfer_resistance", "noise"):
        mine, theirs = entries[name], getattr(episode, name)
        assert mine.dtype == theirs.dtype and mine.tobytes() == theirs.tobytes()


def test_cycle_voltages_are_those_of_the_episode(episode):
    """Step by step what `Episode.voltages` says of the cycle's currents, which begin anew after
    each frame."""
    voltages = cycle_voltages(TINY, 7, recording(TINY, 7))
    assert voltages.shape == (5, 4)
    for t, currents in enumerate(TINY.currents[[0, 1, 0, 1, 0]], start=1):
        np.testing.assert_allclose(voltages[t - 1], episode.voltages(t, currents, TINY), rtol=1e-12)


def test_cycle_voltages_have_the_faults_of_the_episode():
    """What is broken reads interference, and a current that would have to pass it does not flow;
    the recording is the same."""
    faulty = TINY.changed({"instrument": {"dead": [1, 1], "interference": 50.0}})
    entries = recording(TINY, 7)
    assert bits(recording(faulty, 7)) == bits(entries)
    (broken,) = np.flatnonzero(faults_of(faulty, 7).broken_from == 0)
    sound, read = (cycle_voltages(world, 7, entries) for world in (TINY, faulty))
    np.testing.assert_array_equal(read[:, broken], 50.0 * entries["noise"][:, broken])
    passes = np.array([TINY.currents[t % 2, broken] != 0.0 for t in range(5)])
    assert passes.any()
    others = np.delete(np.arange(4), broken)
    np.testing.assert_array_equal(read[np.ix_(passes, others)], 0.0)
    np.testing.assert_array_equal(read[np.ix_(~passes, others)], sound[np.ix_(~passes, others)])


def test_stored_truth_fresh_truth_and_other_process_give_the_same_bits(episode, monkeypatch,
                                                                       tmp_path):
    """A recording does not depend on where its truth came from, nor does an outline; both are kept
    as computed."""
    fresh, stage = recording(TINY, 7), outline(TINY)
    assert bits(fresh) == bits(recordings.make_recording(TINY, 7, episode))
    before = bits(fresh), outline_bits(stage)
    monkeypatch.setattr(episodes, "simulate_together", None)
    recording_path(TINY, 7).unlink()
    forget()
    # from the stored truth
    assert (bits(recording(TINY, 7)), outline_bits(outline(TINY))) == before
    monkeypatch.setattr(recordings, "simulate", None)
    monkeypatch.setattr(recordings, "score_operators", None)
    forget()
    assert (bits(recording(TINY, 7)), outline_bits(outline(TINY))) == before         # from the disk
    here = os.path.dirname(__file__)
    program = (f"import sys; sys.path[:0] = [{here!r}, {os.path.dirname(here)!r}]\n"
               "from test_recordings import *\n"
               "print(digest(recording(TINY, 7), outline(TINY)))")
    for place in (tmp_path / "elsewhere", tmp_path / "cache"):            # anew, and from our files
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True,
                              check=True, env=os.environ | {CACHE_VARIABLE: str(place)})
        assert done.stdout.strip() == digest(fresh, stage)


def test_playing_what_is_stored_needs_no_finite_elements(counted):
    """With recording and outline on disk, making, resetting and stepping an environment builds no
    mesh."""
    recording(TINY, 7), outline(TINY)
    program = (f"import sys, gymnasium as gym, numpy as np, eitbench\n"
               f"env = gym.make('eitbench/Pipe2D-v0', world={CHANGES!r})\n"
               "env.reset(seed=7)\n"
               "rewards = [env.step(np.full(1701, 30.0))[1] for _ in range(5)]\n"
               "heavy = {'skfem', 'numba', 'eitbench.numerics.mesh'}\n"
               "print(rewards[-1] < 0.0, sorted(heavy & set(sys.modules)))")
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True,
                          check=True)
    assert done.stdout == "True []\n"


@pytest.mark.parametrize("seed", [-1, 1.0, True, "7", None])
def test_seed_must_be_a_whole_number(seed):
    """Seeds that would be rounded or cast are refused by name."""
    with pytest.raises(ValueError, match="seed must be an integer of at least 0"):
        recording(TINY, seed)


# -- on disk ---------------------------------------------------------------------------------------


def test_stored_recording_is_mapped_and_read_only(counted):
    """Once stored it is read where it lies, the first time and later, and cannot be changed."""
    recording(TINY, 7)
    forget()
    for entries in (recording(TINY, 7), recording(TINY, 7)):
        assert isinstance(entries.base, np.memmap) and entries.base.mode == "r"
        assert bits(entries) == counted.bits
        for name in entries.dtype.names:
            with pytest.raises(ValueError, match="read-only"):
                entries[name][0] = 0.0
    assert len(counted.calls) == 1


def test_is_recorded_tells_what_is_there(counted):
    """False before, true after, false for another seed, world or a damaged file."""
    assert not is_recorded(TINY, 7)
    recording(TINY, 7)
    assert is_recorded(TINY, 7) and not is_recorded(TINY, 8) and not is_recorded(PIPE_2D, 7)
    forget()
    path = recording_path(TINY, 7)
    path.write_bytes(path.read_bytes()[:-1])
    assert not is_recorded(TINY, 7) and len(counted.calls) == 1


DAMAGE = [
    pytest.param(lambda data: b"", id="empty"),
    pytest.param(lambda data: data[:100], id="part of the header"),
    pytest.param(lambda data: data[:len(data) // 2], id="half"),
    pytest.param(lambda data: data[:-1], id="one byte short"),
    pytest.param(lambda data: b"\0" * len(data), id="zeros"),
    pytest.param(lambda data: data[:len(data) // 2].ljust(len(data), b"\0"), id="half zeros"),
    pytest.param(lambda data: data[:-1] + bytes([data[-1] ^ 1]), id="last bit"),
    pytest.param(lambda data: b"not a recording", id="text"),
]


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_recording_is_rebuilt(damage, counted):
    """What a full disk or a lost power supply leaves is noticed by the next process and replaced
    for all later ones."""
    recording(TINY, 7)
    path = recording_path(TINY, 7)
    path.write_bytes(damage(path.read_bytes()))
    for _ in range(3):
        forget()
        assert bits(recording(TINY, 7)) == counted.bits
    assert len(counted.calls) == 2 and list(path.parent.glob(f"*{path.name}*")) == [path]


def test_any_flipped_byte_of_a_step_is_noticed(counted):
    """Wherever a byte is inverted behind the header, in numbers or checksums, the recording is made
    again."""
    recording(TINY, 7)
    path = recording_path(TINY, 7)
    data = path.read_bytes()
    assert len(data) == HEADER + 5 * counted.bits[0].itemsize
    places = [*range(HEADER, len(data), 211), *range(len(data) - 24, len(data))]
    for place in places:
        path.write_bytes(data[:place] + bytes([data[place] ^ 0xFF]) + data[place + 1:])
        forget()
        assert bits(recording(TINY, 7)) == counted.bits, f"byte {place} of {len(data)}"
    assert len(counted.calls) == 1 + len(places)


def test_file_changed_under_a_running_process_is_read_again(counted):
    """A process that knows a file as sound looks again once its size or its time of change is
    another."""
    recording(TINY, 7)
    assert recording(TINY, 7) is not None
    path = recording_path(TINY, 7)
    data, before = path.read_bytes(), path.stat().st_mtime_ns
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    os.utime(path, ns=(before + 10**6, before + 10**6))
    assert bits(recording(TINY, 7)) == counted.bits and len(counted.calls) == 2
    recording(TINY, 7)
    before = path.stat().st_mtime_ns
    path.write_bytes(data[:-1])
    os.utime(path, ns=(before, before))
    assert bits(recording(TINY, 7)) == counted.bits and len(counted.calls) == 3


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_outline_is_rebuilt(damage):
    """The outline that comes back, and the file it leaves, are as before."""
    good = outline_bits(outline(TINY))
    path = folder(TINY) / "outline.npz"
    path.write_bytes(damage(path.read_bytes()))
    forget()
    assert outline_bits(outline(TINY)) == good
    assert outline_bits(as_outline(store.load(path, OUTLINE))) == good


def test_any_flipped_byte_of_an_outline_is_harmless():
    """Wherever a byte is inverted, the right outline comes back: the file is read as it was meant,
    or not at all."""
    good = outline_bits(outline(TINY))
    path = folder(TINY) / "outline.npz"
    data = path.read_bytes()
    ends = [*range(0, 160, 16), *range(len(data) - 400, len(data), 16)]
    refused = 0
    for place in [*ends, *np.random.default_rng(3).integers(0, len(data), 20)]:
        path.write_bytes(data[:place] + bytes([data[place] ^ 0xFF]) + data[place + 1:])
        stored = store.load(path, OUTLINE)
        refused += stored is None
        assert stored is None or outline_bits(as_outline(stored)) == good, f"byte {place}"
    assert refused > 20


OUTLINE = (*SPARSE, "largest")
"""What an outline's file holds."""


def as_outline(stored):
    """The outline that these arrays hold."""
    return recordings.Outline(sparse_of(stored), float(stored["largest"]))


def test_unwritable_cache_warns_and_still_plays(monkeypatch, cache, counted):
    """Nothing can be kept: each is said in words, and the numbers are those of any other
    machine."""
    def fail(*_):
        raise OSError("no space left on device")

    for module in (recordings, store):
        monkeypatch.setattr(module, "write_atomically", fail)
    said = f"cannot be kept in .*no space left on device.*{CACHE_VARIABLE}"
    with pytest.warns(UserWarning, match=said):
        stage = outline(TINY)
    for _ in range(2):
        with pytest.warns(UserWarning, match="will be simulated again"):
            entries = recording(TINY, 7)
        assert bits(entries) == counted.bits
    assert not cache.exists() and len(counted.calls) == 2
    env = gym.make("eitbench/Pipe2D-v0", world=CHANGES).unwrapped
    with pytest.warns(UserWarning, match="cannot be kept"):
        observation, _ = env.reset(seed=7)
    np.testing.assert_array_equal(observation["voltages"], cycle_voltages(TINY, 7, entries)[0])
    rewards = [env.step(np.full(1701, TINY.background))[1] for _ in range(5)]
    np.testing.assert_allclose(rewards[2:], -(entries["deviation"] / entries["square"])[2:],
                               rtol=1e-12)
    assert rewards[:2] == [0.0, 0.0] and stage.mass.shape == (1701, 1701)


@pytest.mark.parametrize("mask", [0x01, 0x02, 0x08, 0xFF])
def test_any_flipped_byte_of_the_header_is_harmless(mask, counted):
    """Wherever the header is damaged, the right recording comes back."""
    recording(TINY, 7)
    path = recording_path(TINY, 7)
    data = path.read_bytes()
    for place in range(HEADER):
        path.write_bytes(data[:place] + bytes([data[place] ^ mask]) + data[place + 1:])
        forget()
        assert bits(recording(TINY, 7)) == counted.bits, place


def test_recording_is_read_only_from_the_first_call(counted):
    """Also the one that was just simulated."""
    with pytest.raises(ValueError, match="read-only"):
        recording(TINY, 7)["noise"][0] = 0.0


def test_recording_under_another_name_is_not_believed(counted):
    """Seed 7's file is sound, but not as seed 8's."""
    recording(TINY, 7)
    recording_path(TINY, 7).rename(recording_path(TINY, 8))
    assert not is_recorded(TINY, 8)


def test_file_that_cannot_be_opened_is_not_a_missing_one(monkeypatch, counted):
    """With too many files open, the error says so; nothing is simulated in its stead."""
    recording(TINY, 7)

    def refuse(*_):
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(recordings.np, "memmap", refuse)
    with pytest.raises(OSError, match="Too many open files"):
        recording(TINY, 7)
    assert len(counted.calls) == 1
