"""Measured cases: public measurements with vessel, settings and truth, each an environment id.

A case is a YAML file in the folder ``cases``. It identifies its data by sha256 and does not contain
them: `eitbench fetch` downloads them into `measured_folder`.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import quote
from urllib.request import urlopen

import numpy as np
from tqdm import tqdm

from eitbench import _check
from eitbench._extras import require_extra
from eitbench.measured.measurements import Measurements, file_sha256
from eitbench.measured.readers import load_yaml, read
from eitbench.measured.segmentation import read_truth

CASES = Path(__file__).with_name("cases")
CASE_SCHEMA = Path(__file__).with_name("case_schema.json")
"""JSON schema of the entries of a case."""
WITHHELD_FRACTION = 0.1
"""Fraction of the measurements that scores methods."""
FOLDER_VARIABLE = "EITBENCH_MEASURED"
TIMEOUT_S = 60.0
"""Longest time without an answer of the server of a download."""


@dataclass(frozen=True, eq=False)
class MeasuredCase:
    """One set of measurements with its vessel and settings, the same for all methods."""

    name: str
    title: str
    file: str
    """path of the file or folder below `measured_folder`"""
    sha256: str
    """digest of that file, or of all files of the folder in the order of their names"""
    licence: str
    source: str
    """download page"""
    vessel: Mapping[str, Any]
    """entries of `read_vessel`"""
    auxiliary_files: Mapping[str, str] = field(default_factory=dict)
    """name -> sha256 of files that the reader loads from the same folder"""
    truth: Mapping[str, str] | None = None
    """``file`` and ``sha256`` of a segmentation for `read_truth`"""
    address: str = ""
    """of a folder with the files, ending in "/", or of a zip archive whose first folder has them;
    empty: they cannot be downloaded automatically"""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """arguments of `read` and `MeasuredEnv`, and ``span``: start and stop of the injections used"""

    @cached_property
    def digest(self) -> str:
        """sha256 of the entries that affect scores, without texts."""
        content = {"sha256": self.sha256, "beside": dict(self.auxiliary_files),
                   "truth": self.truth and self.truth["sha256"], "vessel": dict(self.vessel),
                   "withheld": WITHHELD_FRACTION, "settings": dict(self.settings)}
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    @property
    def files(self) -> dict[str, str]:
        """Paths of all files below `measured_folder`, and their sha256."""
        truth = {} if self.truth is None else {self.truth["file"]: self.truth["sha256"]}
        beside = {str(Path(self.file).with_name(name)): digest
                  for name, digest in self.auxiliary_files.items()}
        return {self.file: self.sha256} | beside | truth

    @property
    def options(self) -> dict[str, Any]:
        """Arguments of `MeasuredEnv` apart from the measurements and the vessel."""
        return {"withheld": WITHHELD_FRACTION} | {
            name: value for name, value in self.settings.items() if name not in ("format", "span")}

    def measurements(self, file: Path | str | None = None) -> Measurements:
        """Read the measurements, by default from `measured_folder`; ``ValueError`` names a file
        that is missing or has another sha256."""
        path = measured_folder() / self.file if file is None else Path(file)
        self._check(path, self.sha256)
        for name, digest in self.auxiliary_files.items():
            self._check(path.with_name(name), digest)
        span = self.settings.get("span")
        return read(path, self.settings.get("format"), None if span is None else slice(*span))

    def truth_mask(self) -> np.ndarray | None:
        """Read the segmentation (256, 256) of the truth, if any; errors as of `measurements`."""
        if self.truth is None:
            return None
        path = measured_folder() / self.truth["file"]
        self._check(path, self.truth["sha256"])
        return read_truth(path)

    def _check(self, path: Path, digest: str) -> None:
        if not path.exists():
            fetch = f"Run `eitbench fetch {self.name}`, s" if self.address else "S"
            raise ValueError(
                f"case {self.name} requires the file {path.name} with sha256 {digest}, from "
                f"{self.source} (licence: {self.licence}). {fetch}ave it as {path}, or set "
                f"${FOLDER_VARIABLE} to the folder that has {self.file}")
        check_file(path, digest, self.name)


def measured_folder() -> Path:
    """Return $EITBENCH_MEASURED, else eitbench/measured in $XDG_DATA_HOME or ~/.local/share."""
    if folder := os.environ.get(FOLDER_VARIABLE):
        return Path(folder)
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(data) / "eitbench" / "measured"


def read_case(name: Path | str) -> MeasuredCase:
    """Read a built-in case by name, or the case of a YAML file. ``ValueError`` names the file, and
    entries that are missing, unknown, or of the wrong type."""
    path = Path(name)
    if path.suffix != ".yml":
        names = {each.stem: each for each in sorted(CASES.glob("*.yml"))}
        _check.choice("case, if not a YAML file,", str(name), names)
        path = names[str(name)]
    entries = load_yaml(path, "case")
    with require_extra("the YAML file of a case"):
        import jsonschema_rs
    schema = jsonschema_rs.validator_for(json.loads(CASE_SCHEMA.read_text(encoding="utf-8")))
    try:
        wrong = [f"{'.'.join(['case', *map(str, error.instance_path)])}: {error.message}"
                 for error in schema.iter_errors(entries)]
    except ValueError as error:                         # a date, or a name that is not a text
        wrong = [f"case: {error}"]
    if not wrong and (span := entries.get("span", [0, 1]))[0] >= span[1]:
        wrong = [f"case.span: must be two increasing numbers, got {span}"]
    if wrong:
        raise ValueError(f"{path}: {'; '.join(wrong)}")
    fixed = {each.name: entries.pop(each.name) for each in fields(MeasuredCase)
             if each.name in entries}
    return MeasuredCase(path.stem, **fixed, settings=entries)


def check_file(path: Path, digest: str, case: str) -> None:
    """Raise ``ValueError`` unless a file or folder exists and has the sha256 of a case."""
    if (actual := file_sha256(path) if path.exists() else "nothing") != digest:
        raise ValueError(f"{path} must have the sha256 {digest} of the case {case}, got {actual}")


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
