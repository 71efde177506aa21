"""Robustness variants of the thesis' pipe: the task of the nominal environment, and the stated ground truth."""

import numpy as np
import pytest
from eitbench.data.episode_cache import build_cached_episode, cycle_voltages
from eitbench.data.episodes import cached_truth_model, simulate
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.worlds import entries, entry, register, registry
from eitbench.worlds.catalogue import (
    NOMINAL_ID,
    PIPE_2D,
    PIPE_2D_DOUBLE_NOISE,
    PIPE_2D_OTHER_CONTACTS,
    PIPE_2D_OTHER_INLET,
    PIPE_2D_SHORT_SLUGS,
    PIPE_2D_STRONG_SLUGS,
)
from eitbench.worlds.random_streams import episode_streams
from eitbench.worlds.task import make_task
from eitbench.worlds.vessels import PlanePipe, RoundPipe
from scipy.stats import kstest

from short import register_apart, world

SHIFTS = [id for id, each in entries().items() if each.nominal == NOMINAL_ID]


def small(id):
    """Return the world of an id, with episodes of a third of a second."""
    return entry(id).world.with_changes(world(id)["world"])


@pytest.mark.parametrize("id", SHIFTS)
def test_the_task_is_that_of_home(id):
    """Registration compares the settings; transport, and voltages with their derivatives, are equal too."""
    here, there = make_task(small(id)), make_task(small(NOMINAL_ID))
    assert (here.velocity, here.noise, here.calibration) == (there.velocity, there.noise, there.calibration)
    np.testing.assert_array_equal(here.currents, there.currents)
    np.testing.assert_array_equal(here.mesh.points, there.mesh.points)
    c = 30.0 + 5.0 * np.sin(np.arange(there.mesh.n_nodes))
    np.testing.assert_array_equal(here.transport.step(c, 30.0, 31.0), there.transport.step(c, 30.0, 31.0))
    np.testing.assert_equal(here.observation.linearise(c, here.currents),
                            there.observation.linearise(c, there.currents))


@pytest.mark.parametrize(("id", "changes", "home", "message"), [
    ("me/Shift-v0", {}, "eitbench/Nowhere-v0", "nominal must be a registered id that is not shifted itself, got 'e"),
    ("me/Shift-v0", {}, SHIFTS[0], "nominal must be a registered id that is not shifted itself"),
    ("me/Shift-v0", {"instrument": {"noise_relative": 0.02}}, NOMINAL_ID, "me/Shift-v0 and .* differ in noise$"),
    ("me/Shift-v0", {"schedule": {"scored_steps": 9}}, NOMINAL_ID, "differ in schedule, steps$"),
    ("me/Shift-v0", {}, "eitbench/Pipe2DFixedLag-v0", "differ in settings$"),
    ("me/Shift-v0", {}, "eitbench/Pipe2DInjection-v0", "differ in track$"),
])
def test_a_nominal_environment_with_another_task_is_rejected(id, changes, home, message, monkeypatch):
    register_apart(monkeypatch)
    with pytest.raises(ValueError, match=message):
        register(PIPE_2D.with_changes(changes), id, nominal=home)
    assert id not in registry.entries()


def wave(world, seed, times):
    """Return ln(c/background) of the inflow at the model's inlet, (times, nodes)."""
    mesh, inlet = world.vessel.transport_mesh(fine=False)
    inflow = world.target.draw_inflow(world, episode_streams(seed).inflow)
    return np.log(np.array([inflow(mesh.points[inlet], time) for time in times]) / world.background)


def test_strong_slugs_are_those_of_home_half_as_strong_again():
    times = np.arange(0.0, 0.3, 5e-3)
    np.testing.assert_allclose(wave(PIPE_2D_STRONG_SLUGS, 3, times), 1.5 * wave(PIPE_2D, 3, times), atol=1e-12)


def test_short_slugs_last_half_as_long():
    """∫(d ln c/dt)² over ∫(ln c)² of a Gaussian of width s is 1/2s²; of all slugs mean of 1/2s over mean of s."""
    times = np.arange(0.0, 0.4, 1e-3)

    def speed(world):
        waves = np.array([wave(world, seed, times) for seed in range(12)])
        return ((np.diff(waves, axis=1) / 1e-3)**2).mean() / (waves**2).mean()

    shifted, home = speed(PIPE_2D_SHORT_SLUGS), speed(PIPE_2D)
    assert home == pytest.approx(0.5 * np.log(14 / 6) / 8e-3 / 10e-3, rel=0.2)
    assert shifted / home == pytest.approx(4.0, rel=0.1)


def test_measurements_have_twice_the_specified_noise():
    """The fluid is the same as in the nominal environment; also with a noise floor."""
    assert PIPE_2D_DOUBLE_NOISE.truth_config == PIPE_2D.truth_config and PIPE_2D_DOUBLE_NOISE.name == PIPE_2D.name
    here, there = small(SHIFTS[2]), small(NOMINAL_ID)
    assert here.instrument.noise_mismatch == 2.0
    entries = build_cached_episode(there, simulate(there, 7))
    currents = here.currents[np.arange(len(entries)) % len(here.currents)]
    clean = np.einsum("tij,tj->ti", entries["transfer_resistance"], currents)
    for each in (here, here.with_changes({"instrument": {"noise_floor": 1e-3}})):
        expected = 2.0 * make_task(each).noise.std(clean) * entries["noise"]
        np.testing.assert_allclose(cycle_voltages(each, 7, entries) - clean, expected, rtol=1e-9, atol=1e-15)


def test_voltages_are_those_of_electrodes_with_these_contacts():
    """Voltages equal a new complete electrode model with the drawn impedances, and differ from the task's."""
    shifted, home = small("eitbench/Pipe2DOtherContacts-v0"), small(NOMINAL_ID)
    assert shifted.instrument == PIPE_2D_OTHER_CONTACTS.instrument
    assert shifted.instrument.contact_impedance_spread == 0.5
    episode, sound = (simulate(each, 3, cache=False) for each in (shifted, home))
    np.testing.assert_array_equal(episode.concentration, sound.concentration)
    told = shifted.vessel.contact_impedance
    impedance = told * episode_streams(3).contacts.uniform(0.5, 1.5, 4)
    truth = cached_truth_model(home).observation
    sigma = truth.conductivity(truth.interpolation @ episode.concentration[2].astype(float))
    cem = truth.cem
    anew = CompleteElectrodeModel(cem.mesh, cem.electrodes, impedance)
    expected = anew.transfer_resistance(sigma)
    np.testing.assert_allclose(episode.transfer_resistance[1], expected, atol=1e-6 * np.abs(expected).max())
    off = np.abs(sound.transfer_resistance[1] - expected).max() / np.abs(expected).max()
    assert off > 0.002


def test_slugs_of_the_other_inlet_are_at_the_walls():
    """Slugs are at 0.7 to 0.95 R on both sides, nominally at most at 0.7 R, and narrower than nominal ones."""
    reach = PIPE_2D_OTHER_INLET.target.radial_range
    places = PlanePipe().sample_inlet_points(np.random.default_rng(0), 5000, reach)[:, 0] / 0.05
    assert kstest(np.abs(places), "uniform", (0.7, 0.25)).pvalue > 1e-3 and abs(np.sign(places).mean()) < 0.05
    there = np.abs(PlanePipe().sample_inlet_points(np.random.default_rng(0), 5000)) / 0.05
    assert there.max() <= 0.7
    assert PIPE_2D_OTHER_INLET.target.transverse_std[1] < PIPE_2D.target.transverse_std[0]
    for low, high in ((0.0, 0.7), (0.7, 0.95)):
        places = RoundPipe().sample_inlet_points(np.random.default_rng(0), 5000, (low, high)) / 0.05
        assert kstest((places**2).sum(axis=1), "uniform", (low**2, high**2 - low**2)).pvalue > 1e-3     # by area
        assert kstest(np.arctan2(*places.T), "uniform", (-np.pi, 2.0 * np.pi)).pvalue > 1e-3
    middle = np.abs(wave(PIPE_2D_OTHER_INLET, 0, np.arange(0.0, 0.3, 5e-3))).max(axis=0)
    assert middle[10] < 0.02 < 0.2 < middle.max()
