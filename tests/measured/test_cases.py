"""Measured cases: environment ids, records and a leaderboard of data that users download, here from a server on this
machine."""

import json
import shutil
import zipfile
from datetime import date
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread

import gymnasium as gym
import numpy as np
import pytest
import yaml
from eitbench.bench import tracks
from eitbench.bench.records import read_record, read_records, with_content_hash, write_record
from eitbench.bench.runner import run_on_measurements
from eitbench.envs.measured import case_env
from eitbench.measured.cases import CASES, download_case, file_sha256, read_case
from eitbench.measured.segmentation import ktc_score
from eitbench.report.site.measured import MeasuredBoards
from scipy.io import savemat
from tanks import VESSEL, moving, stationary

from commands import eitbench
from tiny import record, write_baseline

TEXTS = {"title": "A body moved round", "file": "moving.h5", "licence": "CC0", "source": "simulator", "moves": False}
ID = "eitbench/Measured-moving-v0"
DIGESTS = {
    "alert": "1ece31d7", "iirc": "126193ab", "kit4-2.3": "4a810db8", "kit4-4.1": "b11a1403",
    "kit4-4.4": "63f64778",
    "ktc-1": "85e6dd58", "ktc-2": "46ab58db", "ktc-3": "563afdd8", "ktc-4": "e39f6c37",
    "montreal": "2264d525", "sciospec-13.19.50": "bac82c37", "sciospec-13.21.48": "40e35de3"}
"""First digits of the digest of each built-in case: other entries require a new version of its id."""


def write_case(path, data, **changes):
    entries = TEXTS | {"sha256": file_sha256(data), "vessel": VESSEL} | changes
    path.write_text(yaml.safe_dump(entries), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Folder with a data file, and its registered case."""
    path = tmp_path_factory.mktemp("measured")
    case = write_case(path / "moving.yml", moving(frames=3).save(path / "moving.h5"))
    gym.register(ID, entry_point=tracks.MEASURED, kwargs={"case": str(case)})
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EITBENCH_MEASURED", str(path))
        yield path
    gym.registry.pop(ID)


def test_built_in_cases_are_ids_outside_the_suites():
    assert {f"eitbench/Measured-{name}-v0" for name in DIGESTS} == set(tracks.measured_ids())
    assert {path.stem for path in CASES.glob("*.yml")} == set(DIGESTS)
    assert not set(tracks.measured_ids()) & set(tracks.ids())
    assert {name: read_case(name).digest[:8] for name in DIGESTS} == DIGESTS


def test_missing_data_are_named(tmp_path, monkeypatch):
    """`gymnasium.make` and `run` name the file, its source, and where to save it."""
    monkeypatch.setenv("EITBENCH_MEASURED", str(tmp_path))
    case = read_case("iirc")
    with pytest.raises(ValueError, match=rf"iirc_data_2006\.mat with sha256 {case.sha256}, from .*eidors") as caught:
        gym.make("eitbench/Measured-iirc-v0")
    assert f"Run `eitbench fetch iirc`, save it as {tmp_path / 'iirc_data_2006.mat'}" in str(caught.value)
    code, _, err = eitbench("run", "--env", "eitbench/Measured-iirc-v0", "--baseline", "homogeneous",
                            "--out", tmp_path / "out")
    assert code == 2
    assert "requires the file iirc_data_2006.mat" in err


def test_other_data_are_rejected(folder):
    """Auxiliary files and the user's `file` are checked too."""
    (folder / "ref.mat").write_bytes(b"empty tank")
    path = write_case(folder / "a.yml", folder / "moving.h5",
                      auxiliary_files={"ref.mat": file_sha256(folder / "ref.mat")})
    assert read_case(path).measurements().currents.shape == (8, 8)
    (folder / "ref.mat").write_bytes(b"not empty")
    with pytest.raises(ValueError, match=r"ref\.mat must have the sha256"):
        read_case(path).measurements()
    other = moving(frames=4).save(folder / "other.h5")
    with pytest.raises(ValueError, match=r"other\.h5 must have the sha256"):
        gym.make(ID, file=other)


def test_a_span_changes_the_digest(folder):
    whole = read_case(folder / "moving.yml")
    part = read_case(write_case(folder / "part.yml", folder / "moving.h5", span=[8, 24]))
    assert part.digest != whole.digest
    np.testing.assert_array_equal(part.measurements().voltages, whole.measurements().voltages[8:24])


@pytest.mark.parametrize(("change", "message"), [
    ({"licence": ""}, "case.licence"), ({"sha256": "abc"}, "case.sha256"),
    ({"title": date(2023, 1, 1)}, r"a\.yml: case: Unsupported type: 'date'"),
    ({"span": [9, 4]}, r"case\.span: must be two increasing numbers, got \[9, 4\]"),
    ({"frames": 3}, "case: .*'frames' was unexpected"),
    ({"auxiliary_files": {"ref.mat": "1"}}, "case.auxiliary_files.ref.mat")])
def test_invalid_entries_are_named(folder, change, message):
    with pytest.raises(ValueError, match=message):
        read_case(write_case(folder / "a.yml", folder / "moving.h5", **change))


def test_unknown_and_incomplete_cases_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"case, if not a YAML file, must be one of .*Did you mean iirc"):
        read_case("irc")
    (tmp_path / "a.yml").write_text("title: a rod", encoding="utf-8")
    with pytest.raises(ValueError, match=r'"file" is a required property; .*"vessel" is a required'):
        read_case(tmp_path / "a.yml")


@pytest.fixture(scope="module")
def submitted(folder):
    """Records of a naive baseline and of a third-party method."""
    method_file = write_baseline(folder, "mine", update="return Estimate(1.1 * self.level)")
    for method, *seeds in (("homogeneous",), (method_file, "--seeds", "test:0")):
        code, _, err = eitbench("submit", "--env", ID, "--baseline", method, "--to", folder / "results",
                                "--out", folder / "store", "--jobs", 1, *seeds)
        assert code == 0, err
    return folder / "results"


@pytest.fixture
def results(submitted, tmp_path):
    return shutil.copytree(submitted, tmp_path / "results")


def record_path(results, method):
    (path,) = results.glob(f"eitbench-Measured-moving-v0--{method}--*.json")
    return path


def test_submit_writes_records_with_the_scores_of_a_run(folder, results):
    """Five episodes withhold different measurements; `run` shows their withheld RMSE instead of ẽ_c, `verify` reruns
    them, and leaderboards of worlds ignore them."""
    code, output, err = eitbench("run", "--env", ID, "--baseline", "homogeneous", "--seeds", "test:0-4", "--jobs", 1,
                                 "--out", folder / "store")
    assert code == 0 and "5 of 5 episodes are already stored" in output + err, err
    assert "withheld RMSE" in output and "ẽ_c" not in output
    written = read_record(record_path(results, "homogeneous"))
    assert written["seeds"] == [f"test:{k}" for k in range(5)]
    run = run_on_measurements(gym.make(ID).unwrapped, "homogeneous", 1)
    scores = written["episodes"][1]["scores"]
    assert scores["prediction_error"] == pytest.approx(run.withheld_rmse, rel=1e-12)
    assert scores["error"] == pytest.approx(run.withheld_rmse**2, rel=1e-12)
    assert written["role"] == "floor"
    assert not written["official"]
    assert read_records(results) == []
    path = record_path(results, "homogeneous")
    assert eitbench("verify", path, "--episodes", 1, "--seed", 3)[0] == 0
    for episode in written["episodes"]:
        episode["scores"]["prediction_error"] *= 0.999
    write_record(results, written)
    code, _, err = eitbench("verify", path, "--episodes", 1, "--seed", 3)
    assert code == 1
    assert "prediction_error" in err


def test_the_leaderboard_shows_records(results):
    """The site and the text show them; titles are escaped, and an invalid file is omitted and named."""
    mine = read_record(record_path(results, "mine")) | {"title": "<b>mine</b>"}
    record_path(results, "mine").write_text(json.dumps(with_content_hash(mine)), "utf-8")
    write_record(results, record("homogeneous", [0.2, 0.3], role="floor"))
    assert eitbench("leaderboard", "--records", results)[0] == 0
    folder = results.parent
    page = (folder / "site" / "measured.html").read_text("utf-8")
    assert 'href="measured.html"' in (folder / "site" / "index.html").read_text("utf-8")
    assert "&lt;b&gt;mine&lt;/b&gt;" in page
    assert "<b>mine" not in page
    text = (folder / "leaderboard.md").read_text("utf-8")
    path = record_path(results, "homogeneous")
    scores = [each["scores"]["prediction_error"] for each in read_record(path)["episodes"]]
    assert f"{np.mean(scores):.3g}" in text[text.index("## measured"):]
    path.write_text(path.read_text("utf-8").replace('"official": false', '"official": true'), "utf-8")
    measured = MeasuredBoards.of(folder)
    assert [each["method"] for each in measured.records["moving"]] == ["mine"]
    assert len(measured.errors) == 1


def test_a_case_with_a_truth_has_the_ktc_score(folder):
    truth = np.zeros((256, 256), dtype=int)
    truth[100:150, 180:230] = 1
    savemat(folder / "truth.mat", {"truth": truth})
    data = stationary().save(folder / "still.h5")
    case = write_case(folder / "still.yml", data, file="still.h5",
                      truth={"file": "truth.mat", "sha256": file_sha256(folder / "truth.mat")})
    env = case_env(case)
    run = run_on_measurements(env, "homogeneous")
    outcome = run.outcome(env)
    assert outcome.ktc == pytest.approx(ktc_score(truth, np.zeros_like(truth)))
    (folder / "truth.mat").unlink()
    with pytest.raises(ValueError, match=r"truth\.mat with sha256"):
        run.outcome(env)


def test_tables_equal_a_computation_by_hand():
    """Order by the mean withheld RMSE; relative to naive baselines by the geometric mean of a method's cases."""
    def record_of(method, values, role=None):
        episodes = [{"seed": f"test:{k}", "status": "ok",
                     "scores": {"prediction_error": value, "seconds_per_step": 0.01}}
                    for k, value in enumerate(values)]
        return {"method": method, "version": "v1", "title": method, "role": role, "official": True,
                "episodes": episodes}

    cases = {name: read_case(name) for name in ("iirc", "montreal")}
    measured = MeasuredBoards(cases, {
        "iirc": [record_of("good", [1.0, 2.0, 3.0]), record_of("naive", [8.0], "floor")],
        "montreal": [record_of("good", [1.0]), record_of("late", [3.0]), record_of("naive", [4.0], "floor")]}, [])
    assert [[cell.plain_text for cell in row.cells] for row in measured.case_table("iirc").rows] == [
        ["good good@v1", "2 1 to 3", "10"], ["naive naive@v1 (naive baseline)", "8 8 to 8", "10"]]
    rows = [[cell.plain_text for cell in row.cells] for row in measured.all_cases_table().rows]
    assert [row[0].split("@")[0] for row in rows] == ["good", "naive", "late"]
    assert [float(row[-1]) for row in rows] == [0.25, 1.0, 0.75]             # √(2/8 · 1/4)
    assert rows[2][1] == "–"


PHOTOGRAPHS = {
    "kit4-2.3": [(0.063, 0.053, 1), (0.0355, -0.056, 1)], "kit4-4.1": [(-0.009, 0.091, 1), (0.040, -0.035, -1)],
    "kit4-4.4": [(0.069, -0.004, 1), (0.021, -0.057, -1)]}
"""Centroids of inclusions in m, read off photographs of the water's surface to about 2 mm; 1 is conductive."""


@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_inclusions_are_located_as_in_photographs(name):
    """The centroid error is less than 1 cm in a tank of 28 cm; requires public files in $EITBENCH_MEASURED."""
    from scipy.ndimage import center_of_mass, label
    try:
        env = case_env(name)
    except ValueError as error:
        pytest.skip(str(error))
    estimate = np.log(run_on_measurements(env, "log_map").mean[-1] / env.task.expected_concentration)
    x, y = np.meshgrid(*[np.linspace(-0.14, 0.14, 141)] * 2)
    inside = x**2 + y**2 < 0.139**2
    field = np.zeros_like(x)
    field[inside] = env.task.mesh.interpolation_to(np.stack([x[inside], y[inside]], axis=1)) @ estimate
    for x_true, y_true, sign in PHOTOGRAPHS[name]:
        near = np.hypot(x - x_true, y - y_true) < 0.02
        labels, _ = label(sign * field > 0.5 * (sign * field)[near].max())
        row, column = center_of_mass(labels == np.bincount(labels[near & (labels > 0)]).argmax())
        assert np.linalg.norm(-0.14 + 0.002 * np.array([column, row]) - [x_true, y_true]) < 0.01


@pytest.fixture
def server(tmp_path, monkeypatch):
    """Folder that a server offers, and its address; the user's folder of measurements is empty."""
    offered = tmp_path / "offered"
    for name, content in {"sub/a.mat": b"data", "sub/ref.mat": b"reference", "frames/1.eit": b"one",
                          "frames/2.eit": b"two", "other/1.eit": b"not wanted"}.items():
        path = offered / "repository-abc" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    with zipfile.ZipFile(offered / "archive.zip", "w") as archive:
        for path in sorted(offered.rglob("*.*t")):
            archive.write(path, path.relative_to(offered))
    monkeypatch.setenv("EITBENCH_MEASURED", str(tmp_path / "measured"))
    handler = partial(SimpleHTTPRequestHandler, directory=offered)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
        thread = Thread(target=running.serve_forever)
        thread.start()
        yield offered / "repository-abc", f"http://127.0.0.1:{running.server_port}"
        running.shutdown()
        thread.join()


def offer_case(offered, address, file="sub/a.mat", **changes):
    return write_case(offered.parent / "mine.yml", offered / file, file=file, address=address, source="s", **changes)


@pytest.mark.parametrize("place", ["archive.zip", "repository-abc/sub/"])
def test_missing_files_are_downloaded(server, tmp_path, place):
    """Archives and folders of single files; the command prints the paths, and a second one downloads nothing."""
    offered, address = server
    path = offer_case(offered, f"{address}/{place}",
                      auxiliary_files={"ref.mat": file_sha256(offered / "sub" / "ref.mat")})
    code, out, _ = eitbench("fetch", path)
    found = tmp_path / "measured" / "sub"
    assert code == 0 and f"wrote {found / 'a.mat'}" in out
    assert (found / "a.mat").read_bytes() == b"data" and (found / "ref.mat").read_bytes() == b"reference"
    assert download_case(read_case(path)) == []
    assert [each.name for each in found.parent.iterdir()] == ["sub"]


def test_a_folder_is_extracted_without_others(server, tmp_path):
    offered, address = server
    (found,) = download_case(read_case(offer_case(offered, f"{address}/archive.zip", "frames")))
    assert sorted(each.name for each in found.iterdir()) == ["1.eit", "2.eit"]
    assert [each.name for each in (tmp_path / "measured").iterdir()] == ["frames"]


def test_nothing_is_kept_of_a_wrong_download(server, tmp_path):
    """Another sha256, a missing file, a file instead of an archive, an unreachable server, a case without address."""
    offered, address = server
    folder = f"{address}/repository-abc/sub/"
    for given, changes, message in [
            (folder, {"auxiliary_files": {"ref.mat": "0" * 64}}, r"ref\.mat must have the sha256 0000"),
            (folder, {"auxiliary_files": {"no.mat": "0" * 64}}, "could not be downloaded from .*404"),
            (f"{address}/archive.zip", {"auxiliary_files": {"no.mat": "0" * 64}}, r"no\.mat must .* got nothing"),
            (f"{address}/repository-abc/sub/a.mat", {}, "could not be downloaded from .*zip"),
            ("http://127.0.0.1:9/", {}, "could not be downloaded"), ("", {}, "has no address: save .*a.mat of s in")]:
        with pytest.raises(ValueError, match=message):
            download_case(read_case(offer_case(offered, given, **changes)))
        assert not (tmp_path / "measured").exists() or not [*(tmp_path / "measured").iterdir()]


def test_built_in_addresses_name_a_commit():
    """A branch would change; the sha256 of each file is in the case."""
    addresses = {path.stem: read_case(path.stem).address for path in CASES.glob("*.yml")}
    assert sum(map(bool, addresses.values())) == 9
    for name, address in addresses.items():
        assert not address or any(len(part) == 40 for part in address.split("/")), name
