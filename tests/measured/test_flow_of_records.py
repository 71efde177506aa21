"""Records of a pipe with a flow that the vessel's description has: known, or asked for."""

import numpy as np
import pytest
import yaml
from eitbench.bench.measured import play_record
from eitbench.data.measured import Measurements
from eitbench.envs.estimation import EstimationEnv
from eitbench.envs.measured import MeasuredEnv, simulated_record
from eitbench.estimation.measured.vessel import read_vessel
from eitbench.physics.transport import ConvectionDiffusion

from commands import eitbench

PIPE = {"kind": "rectangle", "length": 0.4, "width": 0.1, "electrodes": 16, "cover": 0.5}
CYLINDER = {"kind": "cylinder", "length": 0.2, "radius": 0.05, "rings": 2, "electrodes": 4, "height": 0.04,
            "cover": 0.5}
KNOWN = PIPE | {"flow": {"mean_velocity": 4.5}}
ASKED = PIPE | {"flow": {"mean_velocity": 3.5, "velocity_std": 1.0, "velocity_walk": 0.02}}


@pytest.fixture(scope="module")
def simulated():
    return EstimationEnv("eitbench/Pipe2D-v0", world={"schedule": {"scored_steps": 12}})


@pytest.fixture(scope="module")
def record(simulated):
    """An episode at 4.5 m/s, and three records of the same pipe full of homogeneous fluid."""
    episode = simulated_record(simulated, 0)
    electrodes = simulated.world.vessel.electrode_model(fine=True)
    empty = episode.currents @ electrodes.transfer_resistance(np.full(electrodes.mesh.n_nodes, 0.3))
    random = np.random.default_rng(0)
    std = simulated.task.noise.std(empty)
    reference = np.stack([empty + std * random.normal(size=empty.shape) for _ in range(3)])
    return Measurements(episode.currents, episode.injections, episode.matrix, episode.readings, episode.times,
                        reference, episode.source)


@pytest.fixture(scope="module")
def known(record):
    return MeasuredEnv(record, KNOWN)


def test_transport_is_that_of_the_world(simulated, known):
    """The same step of any concentration, at nodes in the same places."""
    ours, theirs = known.task.transport, simulated.task.transport
    assert isinstance(ours, ConvectionDiffusion)
    np.testing.assert_allclose(ours.mesh.points, theirs.mesh.points, atol=1e-12)
    c = 30.0 + np.random.default_rng(1).normal(size=ours.mesh.n_nodes)
    np.testing.assert_allclose(ours.step(c, 30.0, 31.0), theirs.step(c, 30.0, 31.0), rtol=1e-10)
    assert known.task.velocity is None


def test_a_filter_that_knows_the_flow_sees_what_is_carried(known):
    """It misses what it was not shown by less than a third of what homogeneous fluid does."""
    assert play_record(known, "log_inflow_filter").withheld < play_record(known, "homogeneous").withheld / 3


def test_a_velocity_that_is_not_known_is_found(record):
    """From 3.5 m/s believed at first, to within 0.3 of the true 4.5; who says nothing of it keeps to it."""
    env = MeasuredEnv(record, ASKED)
    assert env.action_space.shape == (env.task.mesh.n_nodes + 1,)
    played = play_record(env, "joint_inflow_filter")
    assert played.velocity.shape == (len(record.readings), 1)
    assert played.velocity[-1, 0] == pytest.approx(4.5, abs=0.3)
    np.testing.assert_array_equal(play_record(env, "homogeneous").velocity, 3.5)
    with pytest.raises(ValueError, match="carried by a flow that is asked for, got log_walk_filter"):
        play_record(env, "log_walk_filter")


def test_command_says_the_velocity(record, tmp_path):
    """And draws it."""
    (tmp_path / "pipe.yml").write_text(yaml.safe_dump(ASKED))
    code, said, err = eitbench("estimate", record.save(tmp_path / "pipe.h5"), "--vessel", tmp_path / "pipe.yml",
                               "--baseline", "homogeneous", "--out", tmp_path / "page.html",
                               "--arrays", tmp_path / "said.npz")
    assert code == 0, err
    assert "mean velocity at the end 3.5 m/s" in said
    page = (tmp_path / "page.html").read_text("utf-8")
    assert "How fast the fluid flows" in page
    assert "3.5 m/s on average, ± 1 m/s" in page
    with np.load(tmp_path / "said.npz") as arrays:
        np.testing.assert_array_equal(arrays["velocity"], 3.5)


@pytest.mark.parametrize(("changed", "said"), [
    (PIPE | {"flow": 4.5}, "vessel.flow must have mean_velocity"),
    (PIPE | {"flow": {"velocity_std": 1.0}}, "vessel.flow must have mean_velocity"),
    (PIPE | {"flow": {"mean_velocity": 1.0, "speed": 2.0}}, "vessel.flow must have mean_velocity"),
    (PIPE | {"flow": {"mean_velocity": -1.0}}, "flow.mean_velocity"),
    (CYLINDER | {"flow": {"mean_velocity": 1.0, "velocity_std": 0.1}}, "velocity_std must be 0 in a cylinder"),
    ({"kind": "circle", "radius": 0.1, "electrodes": 8, "cover": 0.4, "flow": {"mean_velocity": 1.0}},
     "vessel of kind circle has no flow")])
def test_flows_that_make_no_sense_are_refused(changed, said):
    with pytest.raises(ValueError, match=said):
        read_vessel(changed)
