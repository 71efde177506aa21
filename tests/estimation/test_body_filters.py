"""The particle filter of a body: signals against the complete electrode model, weights against Bayes' formula, design
criteria against a Gaussian of images and voltages."""

from dataclasses import replace
from functools import lru_cache
from itertools import cycle

import numpy as np
import pytest
from eitbench.bench.methods import builtin_methods, load_method
from eitbench.data.episode_cache import cached_episode, cycle_voltages
from eitbench.data.episodes import cached_truth_model, simulate
from eitbench.envs.injection_core import InjectionCore
from eitbench.estimation.body_particles import BodyParticleFilter, BodyTracker, body_model
from eitbench.estimation.onboard.body_filters import BodyBelief
from eitbench.estimation.onboard.rules import Rules
from eitbench.scoring import matched_distances
from eitbench.worlds import entry
from eitbench.worlds.bodies import TRANSITION_WIDTH, disc_indicator
from eitbench.worlds.random_streams import episode_streams
from eitbench.worlds.task import make_task
from scipy.special import softmax

from short import merged
from short import world as short_world

ID, CHOSEN, SEARCH, BUBBLES, TWO = (f"eitbench/{name}-v0" for name in (
    "TankTracking", "TankReadings", "SearchAndTrack", "BubbleTracking", "TwoBubbleTracking"))


@lru_cache(maxsize=4)
def rules_of(id=ID):
    changes = short_world(id)["world"]
    if id in (BUBBLES, TWO):
        changes = merged(changes, {"vessel": {"truth_refinement": 1}})
    return Rules(entry(id).world.with_changes(changes))


def seen(core, b=0):
    """Return the observation of one episode of a batch."""
    return {name: array[b] for name, array in core.observe().items()}


def believed(id=ID):
    """Return a core after the first frame of an episode and the belief of its observation."""
    core = InjectionCore(rules_of(id), "reduced")
    core.reset([3])
    return core, BodyBelief(core.rules, seen(core))


@pytest.mark.parametrize(("id", "centre", "limit"), [
    (ID, (0.048, 0.015), 0.05), (ID, (0.11, 0.034), 0.12), (BUBBLES, (0.1, 0.02), 0.07),
    (BUBBLES, (0.311, -0.03), 0.12)])
def test_signals_are_those_of_the_complete_electrode_model(id, centre, limit):
    """On the finer mesh of the truth, for a body of the mean radius, also off the points of the grid."""
    rules = rules_of(id)
    model, truth = body_model(make_task(rules.world)), cached_truth_model(rules.world)
    points, target = truth.transport.mesh.points, rules.world.target
    liquid = np.full(len(points), target.background)
    disc = disc_indicator(points, np.array(centre), model.radius, TRANSITION_WIDTH)
    with_body = liquid + (target.concentration - target.background) * disc
    expected = np.subtract(*(truth.observation.transfer_resistance(c) for c in (with_body, liquid)))
    particles = BodyParticleFilter(model, 1, 1).particles
    particles.centres[:] = centre
    particles.areas[:] = 1.0
    index, weights = (each[0, 0] for each in model.cells(particles))
    found = (model.signals[:, index] @ weights).reshape(16, 16)
    scale = (found * expected).sum() / (found**2).sum()          # the effective area is estimated
    assert np.linalg.norm(scale * found - expected) < limit * np.linalg.norm(expected)
    assert scale == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("id", [ID, TWO])
def test_weights_are_those_of_bayes_formula(id, monkeypatch):
    """One measurement from equal weights: the likelihood of each particle's voltages at the measured electrodes,
    relative to the density of the noise, and the moments of the innovation. Signals of bodies add up."""
    core, _ = believed(id)
    filters, rules = core.filters.filter, core.rules
    model = filters.model
    monkeypatch.setattr(model, "move", lambda particles, weights, random: (
        particles, np.full_like(weights, 1.0 / weights.size)))
    pair = 57
    (i, j), amplitude = rules.pairs[pair], rules.amplitude
    found, filters.reweight = [], lambda weights: found.append(weights[0])
    core.act(np.array([pair]))
    base = amplitude * (model.resistance[i] - model.resistance[j])
    neighbours = {(k + step) % 16 for k in (i, j) for step in (-1, 1)}
    measured = sorted(neighbours - {i, j})
    std = model.noise_std(base)[measured]
    index, weights = (each[0] for each in model.cells(filters.particles))
    change = np.einsum("kpc,pc->pk", model.signals[:, index], weights).reshape(-1, 16, 16)
    signals = amplitude * (change[:, :, i] - change[:, :, j])[:, measured]
    variances = std**2 + (model.motion.signal_error * signals)**2
    residuals = core._voltages[0, measured] - base[measured] - signals
    expected = -0.5 * (residuals**2 / variances + np.log(variances / std**2)).sum(axis=1)
    np.testing.assert_allclose(found[0], softmax(expected), rtol=1e-9)
    (innovation,) = core.filters.innovations()
    np.testing.assert_allclose(innovation.value, residuals.mean(axis=0), rtol=1e-9, atol=1e-12)
    S = np.cov(residuals.T, bias=True) + np.diag(variances.mean(axis=0))
    np.testing.assert_allclose(innovation.covariance, S, rtol=1e-9, atol=1e-15)
    assert np.isnan(np.delete(core._voltages[0], measured)).all()


@pytest.mark.parametrize("id", [ID, TWO])
def test_criteria_are_those_of_a_gaussian_of_images_and_voltages(id):
    """A-criterion: the decrease of the image's variances by conditioning; D-criterion: half log det of S R⁻¹."""
    _, belief = believed(id)
    filters, rules = belief.filters.filter, belief.rules
    model, random = filters.model, np.random.default_rng(1)
    gains, information = belief.criteria()
    particles, (w,) = model.move(filters.particles, filters.weights, random)
    index, share = (each[0] for each in model.cells(particles))
    images = np.array([belief.filters.patches[:, index[p]] @ share[p] for p in range(len(w))])
    changes = np.array([model.signals[:, index[p]] @ share[p] for p in range(len(w))]).reshape(-1, 16, 16)
    for pair in (0, 7, 57, 119):
        i, j = rules.pairs[pair]
        current = np.zeros(16)
        current[[i, j]] = rules.amplitude, -rules.amplitude
        measured = rules.instrument.measurement_mask(current)
        std = model.noise_std(model.resistance @ current)[measured]
        voltages = (changes @ current)[:, measured]
        R = np.diag(std**2 + model.motion.signal_error**2 * (w @ voltages**2))
        joint = np.cov(np.hstack([images, voltages]).T, aweights=w, bias=True)
        m = images.shape[1]
        S = joint[m:, m:] + R
        assert gains[pair] == pytest.approx(np.trace(joint[:m, m:] @ np.linalg.solve(S, joint[m:, :m])), rel=1e-6)
        assert information[pair] == pytest.approx(0.5 * np.linalg.slogdet(S @ np.linalg.inv(R))[1], rel=1e-6)


def test_chosen_electrodes_are_the_most_informative_ones():
    """Each one maximises the A-criterion together with those before it, among all electrodes of the pair."""
    core, belief = believed(CHOSEN)
    rules, criteria = core.rules, belief.criteria()
    count = rules.instrument.n_voltmeters
    every = np.tile(np.arange(16), (120, 1))

    def gains(electrodes):
        """Return the criteria with these electrodes (120, k) as the only ones that exist."""
        other = BodyBelief(Rules(rules.world.with_changes({"instrument": {"n_voltmeters": electrodes.shape[1]}})),
                           seen(core))
        other._entries = tuple(np.take_along_axis(each, electrodes, axis=1) for each in other._entries)
        other._variance = np.take_along_axis(other._variance, electrodes, axis=1)
        return other.criteria()

    assert belief.electrodes.shape == (120, count)
    for k in range(count):
        before = belief.electrodes[:, :k]
        table = np.array([gains(np.hstack([before, every[:, [r]]]))[0] for r in range(16)])
        table[before.T, np.arange(120)] = 0.0
        np.testing.assert_allclose(np.take_along_axis(table, belief.electrodes[:, [k]].T, axis=0)[0], table.max(axis=0),
                                   rtol=1e-9)
    np.testing.assert_allclose(criteria, gains(belief.electrodes), rtol=1e-9)


def test_observations_may_have_the_gains_of_all_pairs():
    """They are the A-criteria of a policy with the same observations, for each episode of a batch."""
    core = InjectionCore(replace(rules_of(CHOSEN), gains=True), "reduced")
    core.reset([3, 4])
    beliefs = [BodyBelief(core.rules, seen(core, b)) for b in range(2)]
    core.act(np.array([core.rules.action(57), core.rules.action(3)]))
    for b, belief in enumerate(beliefs):
        belief.update(shown := seen(core, b))
        expected = belief.criteria()[0]
        np.testing.assert_allclose(shown["gains"], expected / expected.max(), rtol=1e-12)


def test_only_chosen_electrodes_are_measured():
    """A driven electrode may be measured; observations have zeros for all others."""
    core, _ = believed(CHOSEN)
    core.act(np.array([[0, 1, 7, 7, 12]]))
    assert np.flatnonzero(core.observe()["voltages"][0]).tolist() == [1, 7, 12]
    assert core.filters.innovations()[0].value.shape == (3,)


def test_bodies_have_the_same_order_in_all_particles():
    """The estimates do not depend on the order of the bodies in the particles, except in the most probable one."""
    filters, random = BodyParticleFilter(body_model(make_task(rules_of(TWO).world)), 1), np.random.default_rng(0)
    weights = np.ones(filters.n_particles)
    weights[7] = 1.1
    swapped = random.uniform(size=len(weights)) < 0.5
    swapped[7] = False
    filters.particles.present[0] = random.uniform(size=(len(weights), 2)) < 0.8
    filters.particles.centres[0] = [[0.1, 0.02], [0.25, -0.02]] + 0.005 * random.standard_normal((len(weights), 2, 2))
    other = filters.repeat(1)
    for each in other.particles:
        each[0, swapped] = each[0, swapped][:, ::-1]
    for each in (filters, other):
        each.reweight(weights[None] / weights.sum())
    np.testing.assert_allclose(other.summaries(), filters.summaries(), rtol=1e-12)


def test_body_has_the_moments_of_the_particles_that_are_present():
    core, _ = believed(SEARCH)
    filters, random = core.filters.filter, np.random.default_rng(0)
    filters.weights[:] = random.dirichlet(np.ones(filters.n_particles))
    filters.particles.present[0, :, 0] = random.uniform(size=filters.n_particles) < 0.3
    present = filters.particles.present[0, :, 0]
    centres, velocities, areas = (each[0, present, 0] for each in filters.particles[:3])
    w = filters.weights[0, present]
    S = np.cov(centres.T, aweights=w, bias=True)
    std = np.sqrt(np.diag(S))
    expected = [*np.average(centres, axis=0, weights=w), *np.average(velocities, axis=0, weights=w), *std,
                S[0, 1] / std.prod(), np.average(areas, weights=w), w.sum()]
    np.testing.assert_allclose(core.observe()["body"][0], expected, rtol=1e-9)


def test_presence_without_measurements_is_that_of_the_markov_chain():
    """More particles enter than bodies; weights correct for it."""
    filters = BodyParticleFilter(body_model(make_task(rules_of(SEARCH).world)), 1, 8192)
    leave, enter = -np.expm1(-0.025 / np.array([1.0, 0.5]))
    expected, found, entries = [1.0], [1.0], []
    for _ in range(60):
        absent = ~filters.particles.present
        filters.assimilate(*np.zeros((2, 1, 16)), np.zeros((1, 16), dtype=bool))
        entries.append((absent & filters.particles.present).sum() / max(absent.sum(), 1))
        expected.append(expected[-1] * (1.0 - leave) + (1.0 - expected[-1]) * enter)
        found.append(filters.summaries()[0, 0, -1])
    np.testing.assert_allclose(found, expected, atol=0.04)
    assert np.max(entries) > 5.0 * enter


def test_lost_bodies_are_found_again():
    """All particles of both bubbles are moved away; without restarts, one bubble stays lost until it leaves."""
    world = entry("eitbench/TwoBubbles2D-v0").world.with_changes(
        {"vessel": {"truth_refinement": 1}, "schedule": {"scored_steps": 24}})
    task, measured = make_task(world), cycle_voltages(world, 1, cached_episode(world, 1))
    paths = world.target.paths(world, episode_streams(1).flow)
    filters = BodyParticleFilter(body_model(task), 1)
    distances = []
    for k, (voltages, currents) in enumerate(zip(measured[:12], cycle(task.currents), strict=False), 1):
        filters.assimilate(voltages[None], currents[None], np.isfinite(voltages)[None])
        if k == 5:
            filters.particles.centres[:] = [0.02, -0.03]
        assert all(path.present[k] for path in paths)
        centres = filters.summaries()[0, :, :2]
        distances.append(max(np.linalg.norm(centres - path.centres[k], axis=1).min() for path in paths))
    assert distances[4] > 0.1 and max(distances[7:]) < 0.025


@pytest.mark.parametrize("id", [CHOSEN, SEARCH])
def test_belief_is_the_filter_inside(id):
    """A belief that a policy updates equals the environment's filter, to the bit."""
    core, belief = believed(id)
    for pair in (7, 100, 3):
        core.act(np.array([core.rules.action(pair)]))
        belief.update(seen(core))
        ours, inside = (each.filters.filter for each in (belief, core))
        np.testing.assert_equal(ours.particles, inside.particles)
        np.testing.assert_array_equal(ours.weights, inside.weights)


def test_tracker_is_the_filter_of_an_episode():
    """NaN marks voltages that are not measured. Its moments are expectations of images, and of their squares, which are
    interpolated on the grid."""
    world = rules_of().world
    task, measured = make_task(world), cycle_voltages(world, 3, cached_episode(world, 3))
    tracker, filters = BodyTracker(task), BodyParticleFilter(body_model(task), 1)
    for voltages, currents in zip(measured, task.currents, strict=False):
        assert np.isnan(voltages).sum() == 12
        tracker.assimilate(voltages, currents)
        filters.assimilate(voltages[None], currents[None], world.instrument.measurement_mask(currents)[None])
    estimate = tracker.estimate()
    index, share = filters.model.cells(filters.particles)
    images = filters.model.images.toarray()[:, index[0]]
    mean = np.einsum("p,pi,npi->n", filters.weights[0], share[0], images)
    second = filters.weights[0] * filters.particles.areas[0, :, 0]
    square = np.einsum("p,pi,npi->n", second, share[0], images**2)
    np.testing.assert_allclose(estimate.mean, 30.0 + mean, rtol=1e-9)
    np.testing.assert_allclose(estimate.variance, square - mean**2, rtol=1e-6, atol=1e-9)
    assert estimate.innovation.shape == (4,) and estimate.innovation_covariance.shape == (4, 4)
    with pytest.raises(ValueError, match=r"^lag must be 0"):
        tracker.estimate(lag=1)


def test_methods_for_stationary_targets_do_not_suit_a_body():
    task = make_task(entry("eitbench/WanderingBody2D-v0").world)
    suitable = {name for name in builtin_methods("estimation") if load_method(name, "estimation").suits(task)}
    assert {"body_particle_filter", "automatic_filter", "random_walk_filter", "noser"} <= suitable
    assert not suitable & {"log_map", "map_estimate", "log_walk_filter", "log_steady_filter", "true_model_smoother"}
    assert not task.is_stationary and make_task(entry("eitbench/StationaryTank2D-v0").world).is_stationary


SHORT_STEPS = {"vessel": {"truth_refinement": 1}, "schedule": {"scored_steps": 24, "warm_up": 8}}
TWO_BUBBLES = entry(TWO).world.with_changes(SHORT_STEPS)
ONE_BUBBLE = entry(BUBBLES).world.with_changes(SHORT_STEPS)


def test_each_body_moves_by_itself():
    """The first one as in the world with one body; the image is the smaller concentration of the two images."""
    one, two = (world.target.paths(world, episode_streams(4).flow) for world in (ONE_BUBBLE, TWO_BUBBLES))
    assert len(one) == 1 and len(two) == 2
    np.testing.assert_array_equal(one[0].centres, two[0].centres)
    assert not np.isclose(two[0].centres, two[1].centres).any() and two[0].radius != two[1].radius
    single, double = (simulate(world, 4, progress=False).concentration for world in (ONE_BUBBLE, TWO_BUBBLES))
    assert (double <= single).all() and (double < 0.5 * single).any()


@pytest.mark.parametrize(("world", "limit"), [(ONE_BUBBLE, 0.012), (TWO_BUBBLES, 0.02)], ids=["one", "two"])
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
        distances += matched_distances(core.filters.bodies()[..., :2], centres, present).tolist()
    estimated = core.filters.bodies()
    np.testing.assert_array_equal(core.observe()["body"].reshape(estimated.shape), estimated)
    assert len(distances) > 20 * world.target.n_bodies and np.median(distances) < limit
