"""Surrogate episodes beside the true ones of the same seeds, and a reduced transport beside the one that it reduces."""

import pickle
from dataclasses import replace
from functools import lru_cache

import eitbench
import numpy as np
import pytest
from eitbench.bench.methods import baseline_folder
from eitbench.data.learning.export import export
from eitbench.estimation import IdentifiedModel, ReducedTransport, Surrogate
from eitbench.worlds.pipe2d import PIPE_2D
from eitbench.worlds.pipe2d_biased import PIPE_2D_BIASED
from eitbench.worlds.registry import entry
from eitbench.worlds.streams import randomness
from eitbench.worlds.task import make_task

from short import merged
from tiny_worlds import CHANGES, FAST

PIPE = "eitbench/Pipe2D-v0"
BIASED = "eitbench/Pipe2DBiasedVelocity-v0"
VARYING = "eitbench/Pipe2DTimeVaryingVelocity-v0"
SKEWED = "eitbench/Pipe2DSkewedVelocity-v0"


@lru_cache(maxsize=1)
def model():
    return IdentifiedModel.load(baseline_folder() / "models" / "pipe2d.npz")


@lru_cache(maxsize=4)
def whole(env, learned=False):
    """Surrogates of a world in full length."""
    return eitbench.surrogate_dataset(env, "dev:0-1", model=model() if learned else None)


def off(examples, surrogate, true):
    """ẽ_c of the surrogate's states, and by how much its voltages are off in parts of the noise, root mean square."""
    std = make_task(examples.world).noise.std(true.voltages)
    voltages = (surrogate.voltages - true.voltages) / std
    return examples.errors(true, surrogate.truth.astype(float)).mean(), np.sqrt((voltages**2).mean())


@pytest.mark.parametrize(("env", "learned", "states", "noise"),
                         [(PIPE, False, 4e-5, 0.35), (PIPE, True, 1e-5, 0.3), (BIASED, False, 4e-5, 0.4)])
def test_they_are_close_to_true_episodes(env, learned, states, noise):
    """States to a two-hundredth, and voltages to less than half of a noise that is the same: another draw of it would
    be off by 1.4. Filters of ours are off by 0.0004 to 0.007."""
    (true,) = eitbench.dataset(env, "dev:0")
    found = off(whole(env), whole(env, learned)[0], true)
    assert found[0] < states and found[1] < noise


def test_another_flow_is_another_episode():
    """The told velocity in place of the episode's own is off by more than filters are."""
    (true,) = eitbench.dataset(BIASED, "dev:0")
    velocity = PIPE_2D_BIASED.flow.draw(PIPE_2D_BIASED, randomness(true.seed).flow)(1).mean_velocity
    assert abs(velocity - 4.5) > 0.3
    told = PIPE_2D_BIASED.changed({"flow": {"velocity_range": [4.5, 4.5]}})
    wrong = Surrogate(told).example(true.seed)
    assert off(whole(BIASED), wrong, true)[0] > 2e-3


@pytest.mark.parametrize(("env", "changes"), [
    (VARYING, merged(FAST, {"flow": {"swing_range": [0.2, 0.3], "period_range": [0.01, 0.02]}})),
    (SKEWED, FAST)])
def test_flows_that_change_or_lean(env, changes):
    """Short worlds, in which the coarse mesh alone is off by half a percent."""
    surrogates = eitbench.surrogate_dataset(env, "dev:0", world=changes)
    (true,) = eitbench.dataset(env, "dev:0", world=changes)
    np.testing.assert_allclose(surrogates[0].velocity, true.velocity, rtol=1e-9)
    assert off(surrogates, surrogates[0], true)[0] < 2e-4


def test_what_is_broken_is_broken_here_too():
    """An open input reads the same interference, whatever is in the pipe."""
    changes = merged(CHANGES, {"instrument": {"dead": [1, 1]}, "vessel": {"electrodes_per_wall": 4}})
    surrogate = eitbench.surrogate_dataset(PIPE, "dev:0", world=changes)[0]
    (true,) = eitbench.dataset(PIPE, "dev:0", world=changes)
    (same,) = np.flatnonzero((surrogate.voltages == true.voltages).all(axis=0))
    others = np.delete(surrogate.voltages - true.voltages, same, axis=1)
    assert (others != 0.0).any(axis=0).all()


def test_what_a_model_leaves_is_drawn():
    """The states differ from those of the response alone by draws of Γ_e, the same ones each time."""
    exact = replace(model(), spread=0.0 * model().spread)
    drawn, alone = (Surrogate(PIPE_2D, each) for each in (model(), exact))
    left = np.concatenate([drawn.concentration(seed) - alone.concentration(seed) for seed in range(24)])
    left /= PIPE_2D.background
    mass = whole(PIPE).mass
    modes = left @ (mass @ model().basis)
    covariance = modes.T @ modes / len(modes)
    np.testing.assert_allclose(np.trace(covariance), np.trace(model().spread), rtol=0.05)
    np.testing.assert_allclose(covariance[0, 0], model().spread[0, 0], rtol=0.15)
    again = Surrogate(PIPE_2D, model()).concentration(3)
    np.testing.assert_array_equal(again, Surrogate(PIPE_2D, model()).concentration(3))


# -- the reduced transport -------------------------------------------------------------------------


@lru_cache(maxsize=1)
def family():
    """Parabolic flows of 40 to 50 m/s, and of another inflow what it becomes in them step by step."""
    world = PIPE_2D_BIASED.changed(FAST)
    transport = make_task(world).transport

    def at(theta):
        return transport.with_velocity(world.vessel.laminar(theta[0]))

    shown = np.stack([world.sample_inflow(seed) for seed in range(24)], axis=2) / world.background - 1.0
    return world, at, ReducedTransport(at, [(40.0, 50.0)], shown, 60)


def stepped(at, inflow, parameters):
    c = np.zeros(at(parameters[0]).mesh.n_nodes)
    states = []
    for t, theta in enumerate(parameters):
        c = at(theta).step(c, inflow[t], inflow[t + 1])
        states.append(c)
    return np.array(states)


@pytest.mark.parametrize("flow", ["steady", "changing"])
def test_few_directions_carry_as_the_mesh_does(flow):
    world, at, reduced = family()
    inflow = world.sample_inflow(77) / world.background - 1.0
    steps = len(inflow) - 1
    parameters = np.full((steps, 1), 43.21) if flow == "steady" else np.linspace(41.0, 49.0, steps)[:, None]
    exact = stepped(at, inflow, parameters)
    left = np.linalg.norm(reduced.carry(inflow, parameters) - exact) / np.linalg.norm(exact)
    other = np.linalg.norm(reduced.carry(inflow, parameters + 1.0) - exact) / np.linalg.norm(exact)
    assert left < 2e-3 and other > 5 * left


def test_directions_are_orthonormal():
    basis = family()[2].basis
    np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-10)


# -- as a data set ---------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def tiny():
    return eitbench.surrogate_dataset(PIPE, "train:0-1", world=CHANGES)


def test_errors_are_formed_beside_the_surrogate():
    """Of what it holds, none; of zero, all."""
    (first, _) = tiny()
    assert tiny().errors(first, first.truth.astype(float)).max() < 1e-12
    np.testing.assert_allclose(tiny().errors(first, np.zeros(first.truth.shape)), 1.0, rtol=1e-6)


def test_another_process_makes_the_same():
    copy = pickle.loads(pickle.dumps(tiny()))
    for name in ("voltages", "truth"):
        np.testing.assert_array_equal(getattr(copy[1], name), getattr(tiny()[1], name))
    np.testing.assert_allclose(tiny().torch()[1]["voltages"].numpy(), tiny()[1].voltages, rtol=1e-6)


def test_files_are_marked(tmp_path):
    """On their card, and they do not mix with true ones."""
    assert export(tiny(), tmp_path / "out") == 2 and export(tiny(), tmp_path / "out") == 0
    card = (tmp_path / "out" / "README.md").read_text()
    assert "surrogates**, to learn from only" in card and "--surrogate --seeds train:0-1" in card
    with np.load(tmp_path / "out" / "train-1.npz") as file:
        np.testing.assert_array_equal(file["voltages"], tiny()[1].voltages)
    with pytest.raises(ValueError, match="format, surrogate or version"):
        export(eitbench.dataset(PIPE, "train:0", world=CHANGES), tmp_path / "out")


@pytest.mark.parametrize(("env", "seeds", "more", "said"), [
    (PIPE, "test:0", {}, "seeds must not be of test episodes"),
    (PIPE, [200_001], {}, "must name the split of test episodes"),
    ("eitbench/StationaryTank2D-v0", "train:0", {}, "target must have an inflow"),
    ("eitbench/Pipe2DOtherContacts-v0", "train:0", {}, "world must have the contacts that are told"),
    ("eitbench/Pipe2DObstacle-v0", "train:0", {"model": True}, "model must be of this world's"),
])
def test_mistakes(env, seeds, more, said):
    given = {"model": model()} if more else {}
    with pytest.raises(ValueError, match=said):
        eitbench.surrogate_dataset(env, seeds, **given)


def test_a_flow_without_a_range_is_refused():
    world = entry(BIASED).world

    class Odd:
        def __getattr__(self, name):
            if name == "velocity_range":
                raise AttributeError(name)
            return getattr(world.flow, name)

    with pytest.raises(ValueError, match="must be steady or have a velocity_range, got Odd"):
        Surrogate(replace(world, flow=Odd()))
