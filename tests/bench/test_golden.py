"""Golden files: numbers of every world and method agree with them, a constant changed by 0.1 % is detected, and a
damaged file is reported.

The default run computes one shortened episode of each world and method; `pytest -m slow` all of them. Worlds with the
same fluid are consecutive, and so are methods of one environment, so that shared data are computed once.
"""

import json

import pytest
from eitbench.bench import golden, methods
from eitbench.bench.methods import baseline_folder
from eitbench.bench.tracks import builtin_ids
from eitbench.worlds import entry

from commands import eitbench
from short import FAST

IDS = builtin_ids()
FLUIDS = list(dict.fromkeys(entry(id).world.truth_config for id in IDS))
BY_FLUID = sorted(IDS, key=lambda id: FLUIDS.index(entry(id).world.truth_config))
METHODS = golden.golden_methods()
BY_ENVIRONMENT = sorted(METHODS, key=lambda name: str((golden.read_golden(name) or {}).get("episodes")))
SLOW = ("filter_bank", "eitbench-Pipe2DInjectionFlow-v0--ppo")
"""Methods whose short episodes take half a minute."""
PLAIN, QUICK = "eitbench/Pipe2D-v0", ("train:0",)


def some(names, is_slow):
    return [pytest.param(name, marks=pytest.mark.slow if is_slow(name) else ()) for name in names]


@pytest.mark.parametrize("name", [*some(BY_FLUID, lambda id: "3D" in id),
                                  *some(BY_ENVIRONMENT, lambda name: name in SLOW)])
def test_shortened_episode_agrees_with_the_golden_file(name):
    """Other numbers require a new version of the id or method. In three dimensions this takes minutes."""
    expected = golden.read_golden(name)
    if name in IDS:
        computed = golden.world_golden(name, QUICK, QUICK)
        expected |= {part: {seed: expected[part][seed] for seed in QUICK} for part in ("episodes", "observations")}
    else:
        expected["episodes"] = expected["episodes"][:1]
        computed = golden.compute(name, expected)
    assert not golden.compare(name, computed, expected)


@pytest.mark.parametrize("id", [id for id in BY_FLUID if "3D" in id])
def test_first_observations_agree_with_the_golden_file(id):
    """For worlds in three dimensions these tests take seconds only."""
    computed = golden.round_numbers(golden.first_observations(id, "train:0"))
    assert not golden.differences(computed, golden.read_golden(id)["observations"]["train:0"])


@pytest.mark.slow
@pytest.mark.parametrize("name", [*BY_FLUID, *BY_ENVIRONMENT])
def test_all_episodes_agree_with_the_golden_file(name):
    """Errors that accumulate over an episode are detected here."""
    expected = golden.read_golden(name)
    assert not golden.compare(name, golden.compute(name, expected), expected)


def test_every_id_and_method_has_its_golden_file_and_nothing_else_has():
    """Agents of one environment and algorithm share a file."""
    assert sorted(golden.WORLD_FOLDER.iterdir()) == sorted(map(golden.golden_path, IDS))
    agents = {f"{path.parents[2].name}--{path.parents[1].name}"
              for path in baseline_folder().glob("checkpoints/*/*/seed*/sha256")}
    files = {path.stem for path in baseline_folder().glob("golden/*.json")}
    assert files == agents | {path.stem for folder in (".", "injection")
                              for path in (baseline_folder() / folder).glob("*.py")}


def test_versions_of_built_in_methods_are_those_of_their_golden_files(monkeypatch, tmp_path):
    """A third-party file has eight digits of its hash as version, whatever its name."""
    monkeypatch.setattr(methods, "golden_version", {"homogeneous": 3, "adjacent": 2}.get)
    assert methods.load_method("homogeneous", "estimation").version == "v3"
    assert methods.load_method("adjacent", "injection").version == "v2"
    own = tmp_path / "own.py"
    own.write_text((baseline_folder() / "homogeneous.py").read_text())
    loaded = methods.load_method(str(own), "estimation")
    assert loaded.version == loaded.sha256[:8]


@pytest.mark.parametrize(("id", "part", "name", "shows", "stays"), [
    (PLAIN, "flow", "diffusivity", {"model.step", "episodes.train:0.resistance"}, "noise"),
    (PLAIN, "instrument", "noise_relative", {"episodes.train:0.voltages", "episodes.train:0.homogeneous"}, "model"),
    pytest.param("eitbench/Pipe2DObstacle-v0", "flow", "viscosity",
                 {"episodes.train:0.moment", "episodes.train:0.resistance"}, "model", marks=pytest.mark.slow)])
def test_constant_off_by_a_thousandth_shows(id, part, name, shows, stays):
    """Only the numbers that depend on the constant change."""
    value = getattr(getattr(entry(id).world, part), name)
    world = entry(id).world.with_changes({part: {name: 1.001 * value}})
    computed = golden.round_numbers(golden.world_numbers(world, ("train:0",)))
    expected = golden.read_golden(id)
    expected = {"model": expected["model"], "episodes": {"train:0": expected["episodes"]["train:0"]}}
    found = {line.split(" ")[0] for line in golden.differences(computed, expected)}
    assert shows <= found and not any(stays in place for place in found)


@pytest.fixture
def copy(tmp_path, monkeypatch):
    """A copy of a golden file in a folder of this test, of a world that is not simulated again."""
    content = golden.read_golden(PLAIN)
    monkeypatch.setattr(golden, "WORLD_FOLDER", tmp_path)
    monkeypatch.setattr(golden, "world_golden", lambda *asked: content)
    golden.golden_path(PLAIN).write_text(json.dumps(content))
    return golden.golden_path(PLAIN)


def test_missing_files_are_written_and_damaged_ones_named(copy):
    """The message has the path, without a traceback."""
    text = copy.read_text()
    for damaged in (text[:len(text) // 2], "", text.replace("[", "(", 1), "\ud800" + text):
        copy.write_bytes(damaged.encode("utf-8", "surrogatepass"))
        code, _, complaint = eitbench("golden", PLAIN)
        assert code == 2 and f"golden file {copy} is damaged" in complaint
    copy.unlink()
    assert list(golden.update([PLAIN])) == [(PLAIN, "new", [])] and json.loads(copy.read_text()) == json.loads(text)


def moved(by):
    """Change one voltage relative to the largest."""
    def change(content):
        voltages = content["episodes"]["dev:0"]["voltages"]
        voltages[2] += by * max(map(abs, voltages))
    return change


@pytest.mark.parametrize(("change", "message"), [
    (lambda made: made["episodes"]["dev:0"]["voltages"].pop(), "dev:0.voltages has 15 numbers, expected 14"),
    (lambda made: made.pop("model"), "the file has other names: model"),
    (lambda made: made.update(model=None), "model is"),
    (lambda made: made["model"].update(step=["fast"] * 5), "model.step is ["),
    (lambda made: made["model"].update(step=[None] * 5), "model.step"),
    (lambda made: made["episodes"].update({"dev:0": []}), "episodes.dev:0 is"),
    (moved(0.01), "episodes.dev:0.voltages differs by 0.01 of its largest"), (moved(0.5 * golden.RTOL_FLOAT64), "")])
def test_difference_is_reported(change, message, copy):
    """Other numbers, names and types are reported, but not a difference within the tolerance."""
    content = golden.read_golden(PLAIN)
    change(content)
    copy.write_text(json.dumps(content))
    ((_, status, found),) = golden.update([PLAIN])
    assert status == ("moved" if message else "same")
    assert any(f"{PLAIN}: " in said and message in said for said in found) if message else not found
    assert golden.differences({"floor": [float("nan")]}, {"floor": [0.02]})


@pytest.fixture
def method_files(monkeypatch, tmp_path):
    """Golden files of one estimator and one policy, reduced to a short episode, in a folder of this test."""
    contents = {name: golden.read_golden(name) for name in ("homogeneous", "best_pair")}
    monkeypatch.setattr(golden, "METHOD_FOLDER", tmp_path)
    for name, content in contents.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(content | {"episodes": content["episodes"][1:2]}))
    return tmp_path


@pytest.mark.parametrize(("name", "change", "message"), [
    ("homogeneous", lambda episode: episode["scores"].update(error=episode["scores"]["error"] * (1 + 1e-5)),
     "error differs by "),
    ("best_pair", lambda episode: episode["injections"].__setitem__(0, [0, 1]), "injections is ")])
def test_changed_numbers_are_written_only_as_a_new_version(name, change, message, method_files):
    """Exit status 1 with the method's name and the number; ``--new-version`` writes the next version."""
    path = method_files / f"{name}.json"
    content = json.loads(path.read_text())
    change(content["episodes"][0])
    path.write_text(json.dumps(content))
    before = path.read_bytes()
    code, output, errors = eitbench("golden", name)
    assert code == 1 and f"{name}: moved" in output and message in errors and path.read_bytes() == before
    code, output, _ = eitbench("golden", name, "--new-version")
    assert code == 0 and f"{name}: v2" in output and json.loads(path.read_text())["version"] == 2
    assert eitbench("golden", name)[:2] == (0, f"{name}: same\n")


def test_files_of_the_same_numbers_are_kept(method_files):
    """The file is not written, also with ``--new-version``; a score that it lacks is ignored."""
    path = method_files / "homogeneous.json"
    content = json.loads(path.read_text())
    scores = content["episodes"][0]["scores"]
    scores["error"] *= 1 + 1e-9
    scores.pop("contrast_error")
    path.write_text(json.dumps(content))
    before = path.read_bytes()
    code, output, _ = eitbench("golden", "homogeneous", "--new-version")
    assert code == 0 and output == "homogeneous: same\n"
    assert path.read_bytes() == before
    assert eitbench("golden", "homogeneous", "worst_pair")[:2] == (2, "")


def test_a_new_method_gets_episodes(method_files, monkeypatch):
    """A new method has two short episodes and a long one of the first compatible environment."""
    monkeypatch.setattr(golden, "SHORT_KWARGS", {"world": FAST})
    monkeypatch.setattr(golden, "_run_episode", lambda episode, method: episode)
    (method_files / "homogeneous.json").unlink()
    assert eitbench("golden", "homogeneous")[:2] == (0, "homogeneous: new\n")
    new = golden.read_golden("homogeneous")
    assert (new["version"], [(each["environment"], each["seed"]) for each in new["episodes"]]) == (
        1, [(PLAIN, "dev:0"), (PLAIN, "dev:1"), (PLAIN, "dev:0")])
