"""Episodes: the truth is reproducible to the last bit, and finer than the estimators' model."""

import numpy as np
import pytest
from eitbench.data import episodes
from eitbench.data.cache import episode_key, store
from eitbench.data.episode_cache import cached_episode
from eitbench.data.episodes import Episode, cached_truth_model, simulate
from eitbench.data.presimulation import presimulate
from eitbench.worlds.catalogue import PIPE_2D
from eitbench.worlds.random_streams import episode_streams

from tiny_worlds import TINY

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


@pytest.mark.parametrize("seed", [-1, 1.0, True, "7", None])
def test_seed_must_be_a_whole_number(seed):
    """Seeds that would be rounded or cast are rejected by name, and so is a wrong number of
    processes."""
    for function in (simulate, cached_episode, lambda world, seed: presimulate(world, [seed])):
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
