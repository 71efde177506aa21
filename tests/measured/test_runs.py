"""Methods on measurements: predictions, inclusions, velocities, smooth motion, electrode residuals, and the command
`estimate`."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from eitbench.bench.measured import plotted_steps
from eitbench.bench.runner import run_on_measurements
from eitbench.envs.estimation import EstimationEnv
from eitbench.envs.measured import MeasuredEnv
from eitbench.estimation.walk import matern32_transition, matern_modes
from eitbench.measured import Measurements
from eitbench.measured.vessel import read_vessel
from tanks import CYLINDER, FIXED_STDS, PIPE, VESSEL, angle, centroid, instrument, moving, simulate_measurements

from commands import eitbench

pytestmark = pytest.mark.usefixtures("coarse")
SMALL_PIPE = PIPE | {"electrodes": 8}
SIMULATED = {"vessel": {"electrodes_per_wall": 4}, "schedule": {"scored_steps": 12}}
ESTIMATED = SMALL_PIPE | {"flow": {"mean_velocity": 3.5, "velocity_std": 1.0, "velocity_walk": 0.02}}


@pytest.fixture(scope="module")
def runs(env):
    return {name: run_on_measurements(env, name)
            for name in ("log_walk_filter", "kalman_filter", "homogeneous", "persistence")}


def test_filters_are_better_than_naive_baselines(env, runs):
    """They predict withheld measurements; the mean centroid error is less than 1.5 cm in a tank of 20 cm."""
    rmse = {name: run.withheld_rmse for name, run in runs.items()}
    assert max(rmse["kalman_filter"], rmse["log_walk_filter"]) < 0.9 * min(rmse["homogeneous"], rmse["persistence"])
    T = env.episode_steps
    errors = [centroid(env.task.mesh.points, runs["log_walk_filter"].mean[t])
              - 0.05 * np.array([np.cos(angle(t, T)), np.sin(angle(t, T))]) for t in range(16, T)]
    assert np.linalg.norm(errors, axis=1).mean() < 0.015


@pytest.mark.parametrize("method", ["back_projection", "noser", "temporal_regularisation"])
def test_images_of_a_frame_find_the_inclusion(method, env):
    """The image of the last frame is blurred by the motion: the centroid is within 2 cm of the middle of the path."""
    turned = angle(env.episode_steps - 4, env.episode_steps)
    found = centroid(env.task.mesh.points, run_on_measurements(env, method).mean[-1])
    np.testing.assert_allclose(found, 0.05 * np.array([np.cos(turned), np.sin(turned)]), atol=0.02)


def test_a_failing_contact_is_visible():
    """The residual of electrode 4 rises when its contact impedance becomes thirty times larger."""
    intact = moving(frames=7, amplitude=0.0)
    broken = moving(frames=7, amplitude=0.0, bad_contact=30.0)
    voltages = np.where(np.arange(56)[:, None] < 32, intact.voltages, broken.voltages)
    env = MeasuredEnv(replace(intact, voltages=voltages), VESSEL, **FIXED_STDS)
    run = run_on_measurements(env, "log_walk_filter")
    np.testing.assert_allclose(run.frame_times, 0.08 * np.arange(7))
    before, after = run.electrode_residual_rms[1:4].max(axis=0), run.electrode_residual_rms[5:].min(axis=0)
    assert after[3] > 3 * before.max()
    assert np.argmax(run.electrode_residual_rms[5:].mean(axis=0)) == 3


def test_electrode_residuals_use_measurements_with_a_driving_electrode(env, runs, measurements):
    """The predicted voltages belong to the estimate of the previous step."""
    run = runs["homogeneous"]
    expected = [env.residuals(t + 1, run.mean[t - 1])[m] for t in range(40, 48) for m in range(8)
                if measurements.matrix[m, 2] != 0 and measurements.currents[t % 8, 2] != 0]
    assert run.electrode_residual_rms[-1, 2] == pytest.approx(np.sqrt(np.mean(np.square(expected))))


def test_estimates_may_be_dropped(env, runs):
    """Scores and residuals still use all steps."""
    kept = plotted_steps(env) - {20}
    run = run_on_measurements(env, "homogeneous", kept=kept)
    assert run.steps.tolist() == sorted(kept)
    for name in ("withheld_residual_rms", "electrode_residual_rms"):
        np.testing.assert_array_equal(getattr(run, name), getattr(runs["homogeneous"], name))
    np.testing.assert_array_equal(run.mean, runs["homogeneous"].mean[run.steps - 1])


@pytest.fixture(scope="module")
def pipe():
    """An episode at 4.5 m/s, with three reference frames of the same pipe."""
    env = EstimationEnv("eitbench/Pipe2D-v0", world=SIMULATED)
    episode = simulate_measurements(env, 0)
    electrodes = env.world.vessel.electrode_model(fine=True)
    empty = episode.currents @ electrodes.transfer_resistance(np.full(electrodes.mesh.n_nodes, 0.3))
    noise = env.task.noise.std(empty) * np.random.default_rng(0).normal(size=(3, *empty.shape))
    return replace(episode, reference=empty + noise)


def test_a_filter_with_the_flow_predicts_better(pipe):
    """The nodes and a transport step of the task are as in the world."""
    env = MeasuredEnv(pipe, SMALL_PIPE | {"flow": {"mean_velocity": 4.5}})
    rmse = [run_on_measurements(env, name).withheld_rmse for name in ("log_inflow_filter", "homogeneous")]
    assert rmse[0] < rmse[1] / 3
    transport, expected = env.task.transport, EstimationEnv("eitbench/Pipe2D-v0", world=SIMULATED).task.transport
    np.testing.assert_allclose(transport.mesh.points, expected.mesh.points, atol=1e-12)
    c = 30.0 + np.random.default_rng(1).normal(size=transport.mesh.n_nodes)
    np.testing.assert_allclose(transport.step(c, 30.0, 31.0), expected.step(c, 30.0, 31.0), rtol=1e-10)
    assert env.task.velocity is None


def test_an_unknown_velocity_is_estimated(pipe):
    """The estimate starts at 3.5 m/s and ends within 0.3 m/s of the true 4.5 m/s."""
    env = MeasuredEnv(pipe, ESTIMATED)
    assert env.action_space.shape == (env.task.mesh.n_nodes + 1,)
    velocity = run_on_measurements(env, "joint_inflow_filter").velocity
    assert velocity.shape == (len(pipe.voltages), 1)
    assert velocity[-1, 0] == pytest.approx(4.5, abs=0.3)
    with pytest.raises(ValueError, match="must suit vessel, flow and target of the measurements, got log_walk_filter"):
        run_on_measurements(env, "log_walk_filter")


def estimate(folder, file, vessel, *arguments):
    (folder / "vessel.yml").write_text(yaml.safe_dump(vessel))
    return eitbench("estimate", file, "--vessel", folder / "vessel.yml", "--out", folder / "page.html", *arguments)


def test_command_writes_page_and_arrays(pipe, tmp_path):
    """Both contain velocities; invalid input writes nothing."""
    file = pipe.save(tmp_path / "pipe.h5")
    arguments = "--baseline", "homogeneous", "--arrays", tmp_path / "arrays.npz"
    code, output, err = estimate(tmp_path, file, ESTIMATED, *arguments)
    assert code == 0, err
    assert "withheld RMSE" in output
    assert "mean velocity at the end 3.5 m/s" in output
    page = (tmp_path / "page.html").read_text("utf-8")
    assert "<h2>Velocity</h2>" in page
    assert "3.5 m/s on average, ± 1 m/s" in page
    with np.load(tmp_path / "arrays.npz") as arrays:
        assert arrays["mean"].shape == (len(pipe.voltages), len(arrays["points"]))
        np.testing.assert_array_equal(arrays["velocity"], 3.5)
    (tmp_path / "page.html").unlink()
    code, _, err = estimate(tmp_path, file, VESSEL | {"electrodes": 16}, *arguments)
    assert code == 2
    assert "vessel must have the 8 electrodes" in err
    assert not (tmp_path / "page.html").exists()


@pytest.mark.parametrize(("vessel", "centre", "tolerance"), [
    (SMALL_PIPE | {"length": 0.3}, [0.12, 0.02], 0.02),
    pytest.param(CYLINDER, [0.02, 0.02, 0.08], 0.03, marks=pytest.mark.slow)], ids=["pipe", "cylinder"])
def test_inclusions_in_other_vessels_are_located(vessel, centre, tolerance):
    """The centroid error is, with few electrodes, less than 2 cm in a pipe of 30 cm, and 3 cm in a pipe of 20 cm."""
    model = read_vessel(vessel).electrode_model(1e-3 * np.linspace(0.8, 1.2, 8))
    inside = np.linalg.norm(model.mesh.points - centre, axis=1) < 0.02
    currents, matrix = instrument()
    empty, full = (currents @ model.transfer_resistance(sigma) @ matrix.T
                   for sigma in (np.full(len(inside), 0.2), np.where(inside, 0.06, 0.2)))
    noise = 1.0 + 1e-3 * np.random.default_rng(0).normal(size=(2, 8, 8))
    empty, full = noise * [empty, full]
    measurements = Measurements(currents, np.arange(8), matrix, full, np.arange(8.0), empty[None], {"file": "pipe"})
    env = MeasuredEnv(measurements, vessel, moves=False)
    found = centroid(env.task.mesh.points, run_on_measurements(env, "log_map").mean[-1])
    assert np.linalg.norm(found - centre) < tolerance


def test_correlation_is_matern():
    """The correlation is (1 + λτ) e^−λτ; short steps compose to a long step, and the variance is
    stationary. Q is ∫ e^Fs L Lᵀ e^Fᵀs ds of dx = F x dt + L dw, with λ = 1 and a spectral density
    of 4."""
    for phase in (0.1, 1.0, 4.0):
        A, Q = matern32_transition(phase)
        assert A[0, 0] == pytest.approx((1 + phase) * np.exp(-phase))
        np.testing.assert_allclose(A @ A.T + Q, np.eye(2))
        assert np.linalg.eigvalsh(Q).min() > -1e-15
        short, _ = matern32_transition(phase / 8)
        np.testing.assert_allclose(np.linalg.matrix_power(short, 8), A, atol=1e-12)
    phase = 0.7
    s = (np.arange(20_000) + 0.5) / 20_000 * phase
    responses = np.array([matern32_transition(each)[0] @ [0.0, 1.0] for each in s])
    np.testing.assert_allclose(matern32_transition(phase)[1], 4 * responses.T @ responses * phase / len(s),
                               rtol=1e-6, atol=1e-9)


def test_modes_reproduce_the_covariance_of_the_field(env):
    """The residual is at most a thousandth of the variance of the strongest mode."""
    walk = env.task.transport
    modes = matern_modes(walk.mesh, walk.length)
    strongest = (modes**2).sum(axis=0).max()
    residual = np.linalg.eigvalsh(walk.covariance - modes @ modes.T)
    assert -1e-9 * strongest < residual.min()
    assert residual.max() <= 1.001e-3 * strongest


def test_smooth_motion_predicts_better_than_a_random_walk(env, runs):
    """The withheld RMSE is at least a tenth smaller for an inclusion that moves half round a tank in 6 frames."""
    assert run_on_measurements(env, "log_steady_filter").withheld_rmse < 0.9 * runs["log_walk_filter"].withheld_rmse
