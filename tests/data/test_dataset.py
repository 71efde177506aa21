"""Training examples: they equal observations and scores of environments, also in exported files."""

import hashlib
import pickle
import re
import sys

import eitbench
import gymnasium as gym
import h5py
import mlcroissant
import numpy as np
import pytest
import torch
import yaml
from eitbench.data.episode_cache import cached_episode, integrals, score_mass, score_operators, step_error
from eitbench.data.episodes import simulate
from eitbench.data.export import export

from short import DRAWN, FAST, WANDERING

PIPE = "eitbench/Pipe2D-v0"
REGION = "eitbench/Pipe2DInjectionFlow-v0"


@pytest.fixture(scope="module")
def tiny():
    """Return a data set of two episodes of five steps."""
    return eitbench.dataset(PIPE, "train:0-1", world=FAST)


def test_they_are_what_the_environment_shows_and_scores(tiny):
    env = gym.make(PIPE, world=FAST)
    random = np.random.default_rng(0)
    for example in tiny:
        observation, _ = env.reset(seed=example.seed)
        estimate = example.truth + random.normal(size=example.truth.shape)
        rewards = []
        for t, mean in enumerate(estimate):
            np.testing.assert_array_equal(observation["voltages"], example.voltages[t])
            np.testing.assert_array_equal(observation["currents"], example.currents[t])
            observation, reward, *_ = env.step(mean)
            rewards.append(reward)
        errors = tiny.errors(example, estimate)
        np.testing.assert_allclose(errors[tiny.warm_up:], -np.array(rewards[tiny.warm_up:]), atol=1e-9)
    assert [example.seed for example in tiny] == [0, 1] and tiny[-1].seed == 1


@pytest.mark.parametrize("env, changes", [(PIPE, FAST), (REGION, WANDERING)])
def test_truth_is_the_best_there_is_on_these_nodes(env, changes):
    """The residual is orthogonal to all nodal functions, over the scored region of the truth's mesh."""
    examples = eitbench.dataset(env, "train:0", world=changes)
    (example,) = examples
    truth = simulate(examples.world, 0).concentration[1:].astype(float)
    interpolation, mass = score_operators(examples.world)
    off = (truth - example.truth @ interpolation.T).T
    weights = mass.sum(axis=0) @ interpolation
    assert np.abs(interpolation.T @ (mass @ off)).max() < 1e-5 * weights.max() * np.abs(off).max()
    np.testing.assert_allclose(example.unresolved, (off * (mass @ off)).sum(axis=0), rtol=1e-4)
    np.testing.assert_allclose(example.square, (truth.T * (mass @ truth.T)).sum(axis=0), rtol=1e-9)
    assert np.abs(example.truth - 28.0).max() < 3.0 * np.abs(truth - 28.0).max()       # beyond a region's edge too


@pytest.mark.parametrize("env, changes", [(PIPE, FAST), (REGION, WANDERING)])
def test_scores_are_the_same_in_few_coordinates(env, changes):
    """Errors are the scores of estimates, also over a region, and the same for estimates in the
    span of a basis, orthonormal or not, about any mean."""
    examples = eitbench.dataset(env, "train:0", world=changes)
    random, world = np.random.default_rng(2), examples.world
    estimate = 30.0 + random.normal(size=examples[0].truth.shape)
    expected = step_error(score_mass(world), estimate - world.background,
                          *integrals(world, cached_episode(world, 0)))
    np.testing.assert_allclose(examples.errors(examples[0], estimate), expected, rtol=1e-6)
    basis = random.normal(size=(examples.mesh.n_nodes, 3))
    for mean in (25.0, 30.0 + random.normal(size=len(basis))):
        reduced = examples.project(basis, mean)
        (example,) = reduced
        said = random.normal(size=example.truth.shape)
        estimate = reduced.concentration(said)
        np.testing.assert_allclose(estimate, mean + said @ basis.T)
        np.testing.assert_allclose(reduced.errors(example, said), examples.errors(examples[0], estimate), rtol=1e-9)
        best = reduced.errors(example, example.truth)
        for nudge in 1e-3 * np.eye(3):
            assert (reduced.errors(example, example.truth + nudge) > best).all()
    assert reduced[0].truth.shape == (len(example.voltages), 3)


def test_modes_are_the_best_basis():
    """Modes are orthonormal over the scored region; the residual equals the omitted singular values, and all of them
    nothing."""
    examples = eitbench.dataset(REGION, "train:0-1", world=WANDERING)
    states = np.concatenate([each.truth[examples.warm_up::2] for each in examples]) - examples.world.background
    squares = np.linalg.eigvalsh(states @ (examples.mass @ states.T))[::-1]        # of the singular values
    modes = examples.pod_modes(len(states))
    for q in (1, len(states)):
        reduced = examples.project(modes[:, :q])
        np.testing.assert_allclose(reduced.mass, np.eye(q), atol=1e-9)
        left = sum((reduced.project_example(each).unresolved - each.unresolved)[examples.warm_up::2].sum()
                   for each in examples)
        assert left == pytest.approx(squares[q:].sum(), rel=1e-5, abs=1e-9 * squares.sum())
    with pytest.raises(ValueError, match=f"q must be at most {len(states)}, .* got {len(states) + 1}"):
        examples.pod_modes(len(states) + 1)


ONES = np.ones((1701, 1))


@pytest.mark.parametrize("call, message", [
    (lambda tiny: eitbench.dataset("eitbench/Nowhere-v0", "train:0"), "env must be one of"),
    (lambda tiny: eitbench.dataset(PIPE, []), r"at least one episode, got \[\]"),
    (lambda tiny: eitbench.dataset(PIPE, [1.5]), "seeds must be an integer"),
    (lambda tiny: eitbench.dataset(PIPE, [3, 200_003]), "must name the split .* 'test:3', got 200003"),
    (lambda tiny: tiny.errors(tiny[0], tiny[0].truth[:-1]), "estimate must have shape"),
    (lambda tiny: tiny.project(np.repeat(ONES, 2, axis=1)), "some of these 2 depend"),
    (lambda tiny: tiny.project(ONES, "much"), "mean must be an array")])
def test_mistakes_are_explained(tiny, call, message):
    with pytest.raises(ValueError, match=message):
        call(tiny)


def test_examples_contain_a_requested_flow():
    """A parabola is in the span of the profiles, so that the fit is exact."""
    examples = eitbench.dataset("eitbench/Pipe2DUnknownVelocity-v0", "train:0", world=DRAWN)
    profiles = examples.world.velocity_model.profiles
    there = simulate(examples.world, 0).velocity
    np.testing.assert_allclose(examples[0].velocity @ profiles.T, there, rtol=1e-9)


def test_iterating_simulates_few_at_a_time(place, asked):
    """Iteration simulates the next eight episodes only: memory is bounded."""
    stream = iter(eitbench.dataset(PIPE, "train:0-8", world=FAST))
    assert next(stream).seed == 0 and asked == [list(range(8))]
    assert [example.seed for example in stream] == list(range(1, 9)) and asked[1:] == [[8]]


def test_torch_loads_batches(tiny):
    """A pickled data set works, as in processes of a data loader."""
    batch = next(iter(torch.utils.data.DataLoader(pickle.loads(pickle.dumps(tiny)), batch_size=2)))
    assert batch.seed.tolist() == [0, 1] and batch.truth.dtype == torch.float32
    for name in ("voltages", "currents", "truth", "square"):
        np.testing.assert_array_equal(getattr(batch, name), np.stack([getattr(example, name) for example in tiny]))


def read(path):
    if path.suffix == ".npz":
        with np.load(path) as file:
            return dict(file)
    with h5py.File(path) as file:
        return {name: np.array(each) for name, each in file.items()}


@pytest.mark.parametrize("format, suffix", [("npz", "npz"), ("hdf5", "h5")])
def test_files_hold_the_same_and_more_can_be_added(tiny, tmp_path, format, suffix):
    first = eitbench.dataset(PIPE, "train:0", world=FAST)
    folder = tmp_path / "out"
    assert export(first, folder, format) == 1
    before = (folder / f"train-0.{suffix}").stat().st_mtime_ns
    assert export(tiny, folder, format) == 1
    assert (folder / f"train-0.{suffix}").stat().st_mtime_ns == before
    for example in tiny:
        fields = read(folder / f"train-{example.seed}.{suffix}")
        for name in ("voltages", "currents", "truth", "unresolved", "square"):
            np.testing.assert_array_equal(fields[name], getattr(example, name))
        assert (fields["seed"] == example.seed).all()
    if format == "hdf5":
        with h5py.File(folder / "train-0.h5") as file:
            assert file["truth"].attrs["units"] == "mol/m³"
    readme = (folder / "README.md").read_text()
    header = yaml.safe_load(readme.split("---")[1])                        # of a Hugging Face data card
    assert ": train:0-1." in readme and header["license"] == "mit" and header["pretty_name"] == PIPE
    metadata = mlcroissant.Dataset(jsonld=str(folder / "croissant.json"))
    assert not metadata.metadata.issues.errors and not metadata.metadata.issues.warnings
    files = {each.name: each.sha256 for each in metadata.metadata.distribution}
    assert files == {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()
                     if path.suffix != ".md" and path.name != "croissant.json"}
    assert {row["arrays/name"] for row in metadata.records("arrays")} == set(first[0]._fields)
    assert metadata.metadata.data_limitations and metadata.metadata.personal_sensitive_information


def test_the_score_in_the_readme_equals_errors(tiny, tmp_path, monkeypatch):
    """The code of the README runs in the folder of its files."""
    export(tiny, tmp_path)
    monkeypatch.chdir(tmp_path)
    (lines,) = re.findall(r"```python\n(.*?)```", (tmp_path / "README.md").read_text(), re.DOTALL)
    names = read(tmp_path / "train-1.npz")
    names["estimate"] = 0.9 * names["truth"]
    exec(lines, names)
    expected = tiny.errors(tiny[1], names["estimate"])[tiny.warm_up:].mean()
    assert names["score"] == pytest.approx(expected, rel=1e-12)


def test_another_folder_is_not_touched(tiny, tmp_path, monkeypatch):
    """A missing library is named before anything is written."""
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(ValueError, match="out must be a new or empty folder"):
        export(tiny, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
    export(tiny, tmp_path / "theirs")
    with pytest.raises(ValueError, match="another environment, format or version"):
        export(tiny, tmp_path / "theirs", "hdf5")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ModuleNotFoundError, match="format hdf5 needs the extra export"):
        export(tiny, tmp_path / "out", "hdf5")
    assert not (tmp_path / "out").exists()
