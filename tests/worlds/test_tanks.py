"""The round tanks: a ball in a steady flow, stationary cylinders, and positions of electrodes."""

import numpy as np
import pytest
from eitbench.data.episodes import cached_truth_model, simulate
from eitbench.numerics.fem import mass_matrix
from eitbench.numerics.round_meshes import electrode_disc
from eitbench.worlds.bodies import disc_indicator
from eitbench.worlds.catalogue import ROTATING_TANK_2D as ROTATING
from eitbench.worlds.catalogue import STATIONARY_TANK_2D as STATIONARY
from eitbench.worlds.random_streams import episode_streams
from eitbench.worlds.vessels import RoundTank
from scipy.integrate import solve_ivp
from scipy.stats import kstest

from short import truths

SHORT = ROTATING.with_changes({"schedule": {"warm_up": 1, "scored_steps": 3}, "vessel": {"n_electrodes": 8}})
"""Four injections of the same flow."""
STILL = STATIONARY.with_changes({"schedule": {"scored_steps": 4}})


@pytest.mark.parametrize(("n_electrodes", "cover"), [(16, 0.5), (7, 0.8)])
def test_electrodes_lie_where_the_spans_say(n_electrodes, cover):
    """Each electrode has ``cells_at_electrodes`` facets, chords of its arc that end at its edges."""
    tank = RoundTank(n_electrodes=n_electrodes, electrode_coverage=cover)
    spans, R = tank.electrode_spans, tank.radius
    middles = 2.0 * np.pi * np.arange(n_electrodes) / n_electrodes
    np.testing.assert_allclose(spans, middles[:, None] + np.pi * cover / n_electrodes * np.array([-1, 1]), atol=1e-12)
    mesh = electrode_disc(R, spans, 6, 12)
    electrodes = tank.electrodes(mesh)
    assert len(electrodes) == n_electrodes
    for facets, (first, last) in zip(electrodes, spans, strict=True):
        ends = mesh.points[facets]
        np.testing.assert_allclose(np.hypot(*np.moveaxis(ends, -1, 0)), R, rtol=1e-12)
        middle = 0.5 * (first + last)
        angle = np.mod(np.arctan2(ends[..., 1], ends[..., 0]) - middle + np.pi, 2.0 * np.pi) - np.pi
        np.testing.assert_allclose([angle.min(), angle.max()], [first - middle, last - middle], atol=1e-9)
        assert np.ptp(angle, axis=1).sum() == pytest.approx(last - first, rel=1e-9)  # without overlap
        assert len(facets) == 6


def test_ball_goes_round_on_an_orbit_of_the_flow():
    """The centre moves with the mean velocity over the disc: an integral over 192 points, solved to high accuracy.

    In 2 s, or 1 m, the error of the path is at most 1 mm, a twentieth of the ball's radius. The flow is at rest at wall
    nodes and facet midpoints; the largest speed is half a metre per second.
    """
    flow, a = ROTATING.flow.nominal(ROTATING, fine=True), ROTATING.target.radius
    ends = flow.mesh.points[flow.mesh.boundary_facets]
    np.testing.assert_allclose(flow(np.concatenate([ends[:, 0], ends.mean(axis=1)])), 0.0, atol=1e-12)
    assert 0.5 < np.linalg.norm(flow(flow.mesh.points), axis=1).max() < 1.0
    path = ROTATING.target.path(ROTATING, episode_streams(1).flow).centres
    s, weights = np.polynomial.legendre.leggauss(8)
    angle = 2.0 * np.pi * np.arange(24) / 24
    round_it = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    disc = (a * np.sqrt(0.5 * (s + 1.0))[:, None, None] * round_it).reshape(-1, 2)
    weights = np.repeat(0.5 * weights / 24, 24)
    times = ROTATING.time_step * np.arange(ROTATING.n_steps + 1)
    orbit = solve_ivp(lambda _, centre: weights @ flow(centre + disc), (0.0, times[-1]), path[0],
                      t_eval=times, rtol=1e-6, atol=1e-8).y.T
    np.testing.assert_allclose(path, orbit, rtol=0.0, atol=1e-3)
    distance = np.hypot(*path.T)
    assert (distance + a < ROTATING.vessel.radius).all()
    way = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    assert way > 2.0 * np.pi * distance.min()           # once round


def test_ball_begins_within_its_range():
    one_step = ROTATING.with_changes({"schedule": {"warm_up": 0, "scored_steps": 1}})
    ball = one_step.target
    starts = np.array([ball.path(one_step, episode_streams(seed).flow).centres[0] for seed in range(50)])
    part = np.hypot(*starts.T) / ROTATING.vessel.radius
    low, high = ball.initial_radius_range
    assert low <= part.min() and part.max() <= high
    assert kstest(part, "uniform", (low, high - low)).pvalue > 1e-3
    assert kstest(np.arctan2(*starts.T), "uniform", (-np.pi, 2.0 * np.pi)).pvalue > 1e-3


def test_ball_keeps_its_content_and_lies_on_its_path():
    """∫(background − c) = πa²·(background − c_ball) to 1 % at every step, and its centroid is the centre, to 0.2 mm."""
    mesh, ball = cached_truth_model(SHORT).transport.mesh, SHORT.target
    concentration = truths(SHORT, 7)[0].concentration
    weights = np.asarray(mass_matrix(mesh).sum(axis=0)).ravel()
    missing = (SHORT.background - concentration) * weights
    expected = np.pi * ball.radius**2 * (SHORT.background - ball.concentration)
    np.testing.assert_allclose(missing.sum(axis=1), expected, rtol=0.01)
    centroid = missing @ mesh.points / missing.sum(axis=1)[:, None]
    path = ball.path(SHORT, episode_streams(7).flow).centres
    np.testing.assert_allclose(centroid, path, atol=2e-4)
    assert np.linalg.norm(path[-1] - path[0]) > 0.01
    assert concentration.min() >= ball.concentration - 1e-4
    assert concentration.max() <= SHORT.background + 1e-4


def test_model_of_the_stirred_tank_has_no_ball_and_keeps_what_it_holds():
    """Concentration is advected and diffuses without inflow or outflow; a constant stays constant."""
    model = SHORT.estimator_model()
    mesh = model.transport.mesh
    assert len(model.transport.inlet) == 0
    weights = np.asarray(mass_matrix(mesh).sum(axis=0)).ravel()
    np.testing.assert_allclose(model.transport.step(np.full(mesh.n_nodes, 30.0), 0.0, 0.0), 30.0, rtol=1e-10)
    blob = c = disc_indicator(mesh.points, np.array([0.05, 0.0]), 0.022, 0.01)
    for _ in range(4):
        c = model.transport.step(c, 0.0, 0.0)
    assert weights @ c == pytest.approx(weights @ blob, rel=0.02)
    centroid = [weights * field @ mesh.points / (weights @ field) for field in (blob, c)]
    assert centroid[1][1] > centroid[0][1] + 0.01                                # counter-clockwise


def test_cylinders_stand_inside_apart_and_anywhere():
    """Radii are uniform in their ranges, gaps exceed ``min_gap``, centres are within ``max_centre_radius``."""
    cylinders, radius = STATIONARY.target, STATIONARY.vessel.radius
    drawn = [cylinders.draw(STATIONARY, episode_streams(seed).flow) for seed in range(300)]
    centres = np.array([[centre for centre, _ in pair] for pair in drawn])
    radii = np.array([[size for _, size in pair] for pair in drawn])
    ranges = cylinders.large_radius, cylinders.small_radius
    for of_kind, (low, high) in zip(radii.T, ranges, strict=True):
        assert low <= of_kind.min() and of_kind.max() <= high
        assert kstest(of_kind, "uniform", (low, high - low)).pvalue > 1e-3
    apart = np.linalg.norm(centres[:, 0] - centres[:, 1], axis=1) - radii.sum(axis=1)
    assert apart.min() > cylinders.min_gap and apart.max() > 2.0 * cylinders.min_gap
    distance = np.linalg.norm(centres, axis=2)
    assert distance.max() <= cylinders.max_centre_radius * radius and (distance + radii).max() < radius
    angle = np.arctan2(centres[:, 0, 1], centres[:, 0, 0])
    assert kstest(angle, "uniform", (-np.pi, 2.0 * np.pi)).pvalue > 1e-3


def test_cylinders_hold_their_metal_and_do_not_move():
    """Concentration and transfer resistance are bit-identical at all times. ∫(c − background) =
    π(a₁² + a₂²)·(metal − 1)·background to 1 %; five-fold inside, the background elsewhere."""
    still = simulate(STILL, 7, cache=False)
    for array in (still.concentration, still.transfer_resistance):
        np.testing.assert_array_equal(array, np.broadcast_to(array[:1], array.shape))
    assert len(np.unique(still.noise)) == still.noise.size
    mesh, c = cached_truth_model(STILL).transport.mesh, still.concentration[0].astype(float)
    cylinders = STILL.target.draw(STILL, episode_streams(7).flow)
    metal, background = STILL.target.concentration_ratio, STILL.background
    expected = np.pi * sum(radius**2 for _, radius in cylinders) * (metal - 1.0) * background
    assert mass_matrix(mesh).sum(axis=0) @ (c - background) == pytest.approx(expected, rel=0.01)
    away = np.min([np.hypot(*(mesh.points - centre).T) - radius for centre, radius in cylinders], axis=0)
    np.testing.assert_allclose(c[away < -0.006], metal * background, rtol=2e-3)
    np.testing.assert_allclose(c[away > 0.006], background, rtol=2e-3)


def test_frame_of_the_tank_at_rest_measures_sixteen_things():
    """Sixteen different injections, eight of them opposite, span all fifteen dimensions of zero sum."""
    currents = STATIONARY.currents
    np.testing.assert_array_equal(np.sort(currents, axis=1)[:, [0, -1]], [[-0.1, 0.1]] * 16)
    np.testing.assert_array_equal((currents != 0).sum(axis=1), 2)
    assert np.linalg.matrix_rank(currents) == 15
    np.testing.assert_array_equal(currents[:8], -np.roll(currents[:8], 8, axis=1))
    pairs = {frozenset(np.flatnonzero(row).tolist()) for row in currents}
    assert len(pairs) == 16                                              # without reversed pairs
