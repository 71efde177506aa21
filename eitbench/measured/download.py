"""Download of the files of measured cases."""

from __future__ import annotations

import os
import shutil
import tempfile
import zipfile
from pathlib import Path
from urllib.parse import quote
from urllib.request import urlopen

from tqdm import tqdm

from eitbench.measured.cases import MeasuredCase, check_file, measured_folder

TIMEOUT_S = 60.0
"""Longest time without an answer of the server."""


def download_case(case: MeasuredCase) -> list[Path]:
    """Download the missing files of a case into `measured_folder` and return their paths.

    All files are checked by their sha256 before the first is moved into place. ``ValueError`` if
    the case has no address, the download fails, or a file has another sha256.
    """
    folder = measured_folder()
    missing = {}
    for name, digest in case.files.items():
        if (folder / name).exists():
            check_file(folder / name, digest, case.name)
        else:
            missing[name] = digest
    if not missing:
        return []
    if not case.address:
        raise ValueError(f"case {case.name} has no address: save {', '.join(missing)} of "
                         f"{case.source} in {folder}")
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="download-", dir=folder) as temporary:
        place = Path(temporary)
        try:
            if case.address.endswith("/"):
                for name in missing:
                    _download(case.address + quote(Path(name).name), place / name)
            else:
                _download(case.address, place / "archive.zip")
                with zipfile.ZipFile(place / "archive.zip") as archive:
                    archive.extractall(place)
                    place /= archive.namelist()[0].partition("/")[0]
        except (OSError, IndexError, zipfile.BadZipFile) as error:
            raise ValueError(f"case {case.name} could not be downloaded from {case.address}: "
                             f"{error}") from None
        for name, digest in missing.items():
            check_file(place / name, digest, case.name)
        for name in missing:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(place / name, folder / name)
    return [folder / name for name in missing]


def _download(address: str, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with urlopen(address, timeout=TIMEOUT_S) as reply, path.open("wb") as file, tqdm.wrapattr(
            reply, "read", total=int(reply.headers.get("Content-Length") or 0), desc=path.name,
            unit_scale=True, disable=None, leave=False) as stream:
        shutil.copyfileobj(stream, file)
