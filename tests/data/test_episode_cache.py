"""Episodes: the truth is reproducible to the last bit. Cached episodes give the scores of the truth and equal the
simulation bit by bit; a prefix equals the first steps of the whole episode, and other steps follow on demand."""

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from eitbench.data import cache, episodes
from eitbench.data.cache import episode_key, store
from eitbench.data.episode_cache import (
    EXTRA_STEPS,
    build_cached_episode,
    cached_episode,
    cached_episode_prefix,
    concentration_at,
    cycle_voltages,
    instrument_faults,
    integrals,
    is_episode_cached,
    scoring_constants,
    step_error,
    truth_mesh,
)
from eitbench.data.episodes import Episode, cached_truth_model, simulate
from eitbench.data.presimulation import presimulate
from eitbench.worlds import entry
from eitbench.worlds.catalogue import PIPE_2D
from eitbench.worlds.random_streams import episode_streams

from shapes import integral_of_square, values_at
from short import FAST, TINY, WANDERING, merged

pytestmark = pytest.mark.usefixtures("place")


def bits(arrays):
    """Types, shapes and bytes of an episode's arrays."""
    return [(array.dtype.str, array.shape, array.tobytes()) for array in arrays]


def test_same_bits_in_this_process_from_the_cache_and_side_by_side(episode, monkeypatch):
    """Episodes depend on the seed only; numpy's global state is neither used nor changed. A simulation up to an
    earlier step has the same bits."""
    np.random.seed(1)  # noqa: NPY002 (the global state is what this is about)
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    assert bits(simulate(TINY, 7, cache=False)) == bits(episode)
    assert (np.random.get_state()[1] == before).all()  # noqa: NPY002
    together = list(episodes.simulate_batch(TINY, [7, 8]))
    assert bits(together[0]) == bits(episode)
    assert bits(together[1]) == bits(simulate(TINY, 8, cache=False))
    assert all((mine != theirs).mean() > 0.9 for mine, theirs in zip(episode[:3], together[1][:3], strict=True))
    (begun,) = episodes.simulate_batch(TINY, [7], last=2)
    assert bits(begun) == bits(Episode(episode.concentration[:3], *(array[:2] for array in episode[1:])))
    first = simulate(TINY, 7)
    monkeypatch.setattr(episodes, "simulate_batch", None)
    assert bits(simulate(TINY, 7)) == bits(first) == bits(episode)


def test_no_cache_neither_reads_nor_writes(episode, place):
    """`cache=False` does not change the folder and simulates even if a file exists."""
    simulate(TINY, 7, cache=False)
    assert not place.exists()
    store(episode_key(TINY, "7.truth"), episode._replace(noise=episode.noise + 1.0)._asdict())
    assert bits(simulate(TINY, 7, cache=False)) == bits(episode)


def test_seed_must_be_a_whole_number():
    """Seeds that would be rounded or cast are rejected by name, and so is a wrong number of processes."""
    for function in (simulate, cached_episode, lambda world, seed: presimulate(world, [seed])):
        for seed in (-1, 1.0, True):
            with pytest.raises(ValueError, match=r"seeds? must be an integer of at least 0"):
                function(TINY, seed)
    with pytest.raises(ValueError, match="n_jobs must be an integer of at least 1"):
        presimulate(TINY, [1], n_jobs=0)


def test_noise_and_resistances_belong_to_the_episode(episode):
    """Noise is the episode's stream of standard normal numbers; 𝓡 at index t − 1 belongs to the concentration at t, on
    the truth's EIT mesh."""
    np.testing.assert_array_equal(episode.noise, episode_streams(7).noise.standard_normal((5, 4)))
    observation = cached_truth_model(TINY).observation
    for t in (1, 5):
        expected = observation.transfer_resistance(episode.concentration[t].astype(float))
        # Concentrations are stored in single precision, resistances as computed.
        np.testing.assert_allclose(episode.transfer_resistance[t - 1], expected, atol=1e-6 * np.abs(expected).max())


def test_inflow_has_slugs_of_both_signs_from_beginning_to_end():
    """Concentration rises and falls by at least a tenth in every episode; its mean is constant in time."""
    points = np.stack([np.zeros(21), np.linspace(-0.05, 0.05, 21)], axis=1)
    times = np.linspace(-0.09, PIPE_2D.n_steps * 5e-3, 400)
    drawn = [PIPE_2D.target.draw_inflow(PIPE_2D, np.random.default_rng(seed)) for seed in range(20)]
    level = np.log([[inflow(points, t) for t in times] for inflow in drawn]).transpose(0, 2, 1) - np.log(30.0)
    assert (level.max(axis=(1, 2)) > np.log(1.1)).all()
    assert (level.min(axis=(1, 2)) < np.log(0.9)).all()
    assert abs(level.mean()) < 0.05
    activity = np.sqrt((level**2).mean(axis=(0, 1)))                # over time
    assert activity[:40].mean() > 0.6 * activity.mean()
    assert activity[-40:].mean() > 0.6 * activity.mean()


@pytest.fixture(scope="module")
def to_truth():
    """Return the dense interpolation from the model's nodes to the truth's."""
    return values_at(truth_mesh(TINY).points, TINY.estimator_model().transport.mesh)


@pytest.fixture(scope="module")
def entries(episode):
    """Return the cached episode of `episode`."""
    return build_cached_episode(TINY, episode)


def test_score_is_the_integral_over_the_truth(episode, entries, to_truth):
    """The step error from moments equals ∫(ĉ − c)²/∫c² over the truth's triangles for any estimate: near the truth,
    good, bad and constant ones.

    The relative tolerance is 1e-6, plus 3e-10 for the single precision of the moments (measured: 6e-11).
    """
    exactly = {"rtol": 1e-6, "atol": 3e-10}
    mesh, nodes = truth_mesh(TINY), TINY.estimator_model().transport.mesh.points
    truth = episode.concentration[1:].astype(float)
    nearest, rng = truth @ mesh.interpolation_to(nodes).T, np.random.default_rng(1)
    estimates = [nearest, nearest + rng.normal(size=(5, 1)) + rng.normal(size=(5, len(nodes))),
                 rng.uniform(-250.0, 250.0, (5, len(nodes))), np.full((5, len(nodes)), 25.0),
                 np.full((5, len(nodes)), TINY.background)]
    mass = scoring_constants(TINY).mass
    for estimate in estimates:
        exact = integral_of_square(mesh, estimate @ to_truth.T - truth) / integral_of_square(mesh, truth)
        if estimate is nearest:
            assert exact.max() < 1e-4               # the projection error on the coarser mesh
        scored = step_error(mass, estimate - TINY.background, *integrals(TINY, entries))
        np.testing.assert_allclose(scored, exact, **exactly)
        for t in range(5):                             # one step at a time, as in environments
            one = step_error(mass, estimate[t] - TINY.background, *integrals(TINY, entries[t]))
            np.testing.assert_allclose(one, exact[t], **exactly)


def test_outline_knows_the_largest_voltage():
    """The largest voltage of the injection cycle at the expected concentration."""
    observation, level = TINY.estimator_model().observation, np.full(1701, TINY.expected_concentration)
    largest = max(np.abs(observation.transfer_resistance(level) @ currents).max() for currents in TINY.currents)
    assert scoring_constants(TINY).largest_voltage == pytest.approx(largest, rel=1e-10)


def test_resistances_noise_and_voltages_are_those_of_the_episode(episode):
    """Transfer resistances and noise are stored without rounding. V = 𝓡I + std·n with std² = (1 %
    of the measurement)² + (0.1 % of the largest)² and the currents of the cycle, which repeats."""
    entries = cached_episode(TINY, 7)
    assert entries.shape == (5,) and entries["moment"].shape == (5, 1701)
    for name in ("transfer_resistance", "noise"):
        mine, theirs = entries[name], getattr(episode, name)
        assert mine.dtype == theirs.dtype and mine.tobytes() == theirs.tobytes()
    clean = np.einsum("tij,tj->ti", episode.transfer_resistance, TINY.currents[[0, 1, 0, 1, 0]])
    std = np.hypot(0.01 * clean, 0.001 * np.abs(clean).max(axis=1, keepdims=True))
    np.testing.assert_allclose(cycle_voltages(TINY, 7, entries), clean + std * episode.noise, rtol=1e-12)


def test_cycle_voltages_have_the_faults_of_the_episode(entries):
    """A broken electrode measures interference, and a current through it does not flow."""
    faulty = TINY.with_changes({"instrument": {"n_dead_range": [1, 1], "interference": 50.0}})
    (broken,) = np.flatnonzero(instrument_faults(faulty, 7).open_circuit_from == 0)
    sound, read = (cycle_voltages(world, 7, entries) for world in (TINY, faulty))
    np.testing.assert_array_equal(read[:, broken], 50.0 * entries["noise"][:, broken])
    passes = np.array([TINY.currents[t % 2, broken] != 0.0 for t in range(5)])
    assert passes.any()
    others = np.delete(np.arange(4), broken)
    np.testing.assert_array_equal(read[np.ix_(passes, others)], 0.0)
    np.testing.assert_array_equal(read[np.ix_(~passes, others)], sound[np.ix_(~passes, others)])


def test_cached_episodes_need_no_finite_elements(episode):
    """Environments build no mesh if the episode and the scoring constants are cached."""
    cached_episode(TINY, 7), scoring_constants(TINY)
    program = (f"import sys, gymnasium as gym, numpy as np, eitbench\n"
               f"env = gym.make('eitbench/Pipe2D-v0', world={FAST!r})\n"
               "env.reset(seed=7)\n"
               "rewards = [env.step(np.full(1701, 30.0))[1] for _ in range(5)]\n"
               "heavy = {'skfem', 'numba', 'eitbench.numerics.mesh'}\n"
               "print(rewards[-1] < 0.0, sorted(heavy & set(sys.modules)))")
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "True []\n"


LONGER = {id: merged(changes, {"schedule": {"scored_steps": 32}}) for id, changes in {
    "eitbench/Pipe2DFixedLag-v0": FAST, "eitbench/Pipe2DInjectionFlow-v0": WANDERING,
    "eitbench/StationaryTank2D-v0": {}}.items()}
"""Changes to worlds of some 34 steps; more than half the time of a shorter episode is in its first steps."""


@pytest.mark.parametrize("id", LONGER)
def test_first_steps_have_the_bits_of_the_whole(id):
    world = entry(id).world.with_changes(LONGER[id])
    begun = cached_episode_prefix(world, 3, 1)
    assert len(begun) == 1 + EXTRA_STEPS and not is_episode_cached(world, 3)
    states = [concentration_at(world, 3, t, 1) for t in (0, 1 + EXTRA_STEPS)]
    assert not list(cache.folder(world).glob("3.*"))                       # without temporary files
    whole = cached_episode(world, 3)
    assert begun.tobytes() == whole[:1 + EXTRA_STEPS].tobytes()
    truth = simulate(world, 3).concentration
    for t, state in zip((0, 1 + EXTRA_STEPS), states, strict=True):
        assert (state == truth[t]).all()
    assert len(cached_episode_prefix(world, 3, 1)) == world.n_steps


def test_episodes_are_the_same_with_and_without_a_cache():
    """Observations and rewards are bit-identical; an episode is not cached before a step needs it."""
    id = "eitbench/Pipe2DInjectionFlow-v0"
    world = entry(id).world.with_changes(LONGER[id])

    def played():
        env = gym.make(id, world=LONGER[id], estimator="none")
        observation, _ = env.reset(seed=4)
        env.action_space.seed(0)
        seen = [observation]
        ended = False
        recorded = [is_episode_cached(world, 4)]
        while not ended:
            observation, reward, ended, _, _ = env.step(env.action_space.sample())
            seen += [observation, reward]
            recorded.append(is_episode_cached(world, 4))
        return seen, recorded

    first, recorded = played()
    assert not any(recorded[:EXTRA_STEPS]) and recorded[-1]
    again, recorded = played()
    assert all(recorded)
    np.testing.assert_equal(again, first)
