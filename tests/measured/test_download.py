"""Downloads of measured cases, from a server on this machine."""

import zipfile
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread

import pytest
import yaml
from eitbench.measured.cases import CASES, download_case, file_sha256, read_case
from tanks import VESSEL

from commands import eitbench


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


def write_case(offered, address, file="sub/a.mat", **changes):
    entries = {"title": "a", "file": file, "licence": "CC0", "source": "s", "vessel": VESSEL, "address": address,
               "sha256": file_sha256(offered / file)} | changes
    path = offered.parent / "mine.yml"
    path.write_text(yaml.safe_dump(entries), encoding="utf-8")
    return path


@pytest.mark.parametrize("place", ["archive.zip", "repository-abc/sub/"])
def test_missing_files_are_downloaded(server, tmp_path, place):
    """Archives and folders of single files; the command prints the paths, and a second one downloads nothing."""
    offered, address = server
    path = write_case(offered, f"{address}/{place}",
                      auxiliary_files={"ref.mat": file_sha256(offered / "sub" / "ref.mat")})
    code, out, _ = eitbench("fetch", path)
    found = tmp_path / "measured" / "sub"
    assert code == 0 and f"wrote {found / 'a.mat'}" in out
    assert (found / "a.mat").read_bytes() == b"data" and (found / "ref.mat").read_bytes() == b"reference"
    assert download_case(read_case(path)) == []
    assert [each.name for each in found.parent.iterdir()] == ["sub"]


def test_a_folder_is_extracted_without_others(server, tmp_path):
    offered, address = server
    (found,) = download_case(read_case(write_case(offered, f"{address}/archive.zip", "frames")))
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
            download_case(read_case(write_case(offered, given, **changes)))
        assert not (tmp_path / "measured").exists() or not [*(tmp_path / "measured").iterdir()]


def test_built_in_addresses_name_a_commit():
    """A branch would change; the sha256 of each file is in the case."""
    addresses = {path.stem: read_case(path.stem).address for path in CASES.glob("*.yml")}
    assert sum(map(bool, addresses.values())) == 9
    for name, address in addresses.items():
        assert not address or any(len(part) == 40 for part in address.split("/")), name
