"""Two bodies: their truth, the mean-field update against Bayes' formula, and tracking with one pair after another."""

from functools import lru_cache

import numpy as np
import pytest
from eitbench.data.episodes import simulate
from eitbench.envs.injection_core import InjectionCore
from eitbench.estimation.body_particles import BodyParticleFilter, body_model
from eitbench.estimation.onboard.rules import Rules
from eitbench.scoring import matched_distances
from eitbench.worlds.random_streams import episode_streams
from eitbench.worlds.registry import entry
from eitbench.worlds.task import make_task

SHORT = {"vessel": {"truth_refinement": 1}, "schedule": {"scored_steps": 24, "warm_up": 8}}
TWO = entry("eitbench/TwoBubbleTracking-v0").world.with_changes(SHORT)
ONE = entry("eitbench/BubbleTracking-v0").world.with_changes(SHORT)


def test_each_body_moves_by_itself():
    """The first one as in the world with one body; the image is the smaller concentration of the two images."""
    one, two = (world.target.paths(world, episode_streams(4).flow) for world in (ONE, TWO))
    assert len(one) == 1 and len(two) == 2
    np.testing.assert_array_equal(one[0].centres, two[0].centres)
    assert not np.isclose(two[0].centres, two[1].centres).any() and two[0].radius != two[1].radius
    single, double = (simulate(world, 4, progress=False).concentration for world in (ONE, TWO))
    assert (double <= single).all() and (double < 0.5 * single).any()


@lru_cache(maxsize=1)
def signals():
    """Return a filter of two bodies after a step, the injection's voltages, and the voltages of each particle."""
    filters = BodyParticleFilter(body_model(make_task(TWO)), 1, 48)
    model, random = filters.model, np.random.default_rng(1)
    for body in filters.bodies:
        body.move(random)
        body.weights = random.dirichlet(np.full(48, 5.0))[None]
    currents = np.zeros((1, 16))
    currents[0, [2, 10]] = 0.01, -0.01
    measured = TWO.instrument.measurement_mask(currents)
    base = currents[0] @ model.resistance
    changes = []
    for body in filters.bodies:
        index, shares = (each[0] for each in model.cells(body.particles))
        changes.append([(model.signals[:, k] @ share).reshape(16, 16) @ currents[0]
                        for k, share in zip(index, shares, strict=True)])
    return filters, currents, measured, base, np.array(changes)[:, :, measured[0]]


def assimilated(voltages, weights):
    """Return the bodies' posterior weights and the innovation of a filter that starts with these weights."""
    filters, currents, measured, *_ = signals()
    found = []
    for body, own in zip(filters.bodies, weights, strict=True):
        body.weights = own[None]
        body.move = lambda random: None
        body.reweight = lambda posterior, random: found.append(posterior[0])
    filters.assimilate(voltages[None], currents, measured)
    return found, filters.innovation


def test_the_update_is_exact_where_the_other_body_is_known():
    """Bayes' formula with the other body's voltages; the innovation has the moments of both."""
    filters, _, measured, base, changes = signals()
    weights = [body.weights[0].copy() for body in filters.bodies]
    known = 7
    weights[1] = (np.arange(48) == known).astype(float)
    voltages = base.copy()
    voltages[measured[0]] += changes[0, 3] + changes[1, known]
    found, (innovation, S, _) = assimilated(voltages, weights)
    noise = filters.model.noise_std(base)[measured[0]]**2
    error = filters.model.motion.signal_error
    sums = changes[0] + changes[1, known]
    spread = noise + error**2 * (changes[0]**2 + changes[1, known]**2)
    rest = voltages[measured[0]] - base[measured[0]] - sums
    expected = weights[0] * np.exp(-0.5 * (rest**2 / spread + np.log(spread)).sum(axis=1))
    np.testing.assert_allclose(found[0], expected / expected.sum(), rtol=1e-8, atol=1e-300)
    mean = weights[0] @ rest
    covariance = np.cov(rest.T, aweights=weights[0], bias=True) + np.diag(weights[0] @ spread)
    np.testing.assert_allclose(innovation[0], mean, rtol=1e-9)
    np.testing.assert_allclose(S[0], covariance, rtol=1e-9)


def test_the_update_is_near_the_joint_posterior():
    """All 48² pairs of particles: the mean voltages of the product are five times nearer to the joint posterior's than
    the predicted ones, in the mean over 30 measurements."""
    filters, _, measured, base, changes = signals()
    weights = [body.weights[0].copy() for body in filters.bodies]
    noise = filters.model.noise_std(base)[measured[0]]**2
    error = filters.model.motion.signal_error
    sums = changes[0][:, None] + changes[1]
    spread = noise + error**2 * (changes[0]**2)[:, None] + error**2 * changes[1]**2
    random = np.random.default_rng(2)
    improvement = []
    for _ in range(30):
        i, j = (random.choice(48, p=each) for each in weights)
        voltages = base.copy()
        voltages[measured[0]] += sums[i, j] + np.sqrt(noise) * random.standard_normal(len(noise))
        found, _ = assimilated(voltages, weights)
        rest = voltages[measured[0]] - base[measured[0]] - sums
        joint = np.outer(*weights) * np.exp(-0.5 * (rest**2 / spread + np.log(spread)).sum(axis=2))
        joint /= joint.sum()
        exact, mean_field, prior = (np.einsum("ij,ijm->m", each, sums)
                                    for each in (joint, np.outer(*found), np.outer(*weights)))
        improvement.append([np.linalg.norm(each - exact) for each in (mean_field, prior)])
    error, before = np.mean(improvement, axis=0)
    assert error < 0.2 * before


@pytest.mark.parametrize(("world", "limit"), [(ONE, 0.012), (TWO, 0.02)], ids=["one", "two"])
def test_the_filter_follows_bubbles(world, limit):
    """Three pairs in turn locate most of the bubbles; the observation has the estimates of all
    bodies."""
    rules, seeds = Rules(world), [0, 1, 2, 3]
    core = InjectionCore(rules, "reduced")
    core.reset(seeds)
    paths = [world.target.paths(world, episode_streams(seed).flow) for seed in seeds]
    distances = []
    for k in range(core.length):
        core.act(np.full(len(seeds), rules.pairs.tolist().index(([2, 9], [0, 7], [5, 9])[k % 3])))
        centres, present = (np.array([[getattr(path, name)[core.t] for path in own] for own in paths])
                            for name in ("centres", "present"))
        distances += matched_distances(core.bodies()[..., :2], centres, present).tolist()
    estimated = core.bodies()
    np.testing.assert_array_equal(core.observe()["body"].reshape(estimated.shape), estimated)
    assert len(distances) > 20 * world.target.n_bodies and np.median(distances) < limit
