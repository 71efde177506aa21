"""Measured cases: public measurements with vessel, settings and truth, each an environment id.

A case is a YAML file in the folder ``cases``. It identifies its data by sha256 and does not contain
them: `eitbench fetch` downloads them into `measured_folder`.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from eitbench import _check
from eitbench.measured.measurements import Measurements
from eitbench.measured.readers import load_yaml, read
from eitbench.measured.segmentation import read_truth

CASES = Path(__file__).with_name("cases")
WITHHELD_FRACTION = 0.1
"""Fraction of the measurements that scores methods."""
FOLDER_VARIABLE = "EITBENCH_MEASURED"
_TEXTS = ("title", "file", "sha256", "licence", "source")
_OPTIONAL = ("auxiliary_files", "truth", "address")
_SETTINGS = ("format", "span", "correction", "homogeneous_frames", "moves", "model_error")
"""Arguments of `read` and `MeasuredEnv`, and ``span``: start and stop of the injections used."""


@dataclass(frozen=True, eq=False)
class MeasuredCase:
    """One set of measurements with its vessel and settings, the same for all methods.

    ``ValueError`` names an entry that is missing, unknown, or of the wrong type.
    """

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

    def __post_init__(self) -> None:
        for name in _TEXTS:
            value = getattr(self, name)
            if not isinstance(value, str) or not value.strip():
                raise ValueError(f"case.{name} must be a text, got {value!r}")
        for name, entries in {"vessel": self.vessel, "truth": self.truth or {},
                              "auxiliary_files": self.auxiliary_files}.items():
            if not isinstance(entries, Mapping):
                raise ValueError(f"case.{name} must be entries like 'name: value', got {entries!r}")
        if self.truth is not None and set(self.truth) != {"file", "sha256"}:
            raise ValueError(f"case.truth must have file and sha256, got {self.truth!r}")
        if not re.fullmatch(r"(https?://\S+)?", str(self.address)):
            raise ValueError(f"case.address must begin with https://, got {self.address!r}")
        digests = {"sha256": self.sha256, **self.auxiliary_files,
                   **({"truth.sha256": self.truth["sha256"]} if self.truth else {})}
        for name, digest in digests.items():
            if not isinstance(digest, str) or not re.fullmatch("[0-9a-f]{64}", digest):
                raise ValueError(f"case.{name} must be 64 hexadecimal digits, got {digest!r}")
        span = self.settings.get("span", [0, 1])
        if not (isinstance(span, list) and [*map(type, span)] == [int, int]
                and 0 <= span[0] < span[1]):
            raise ValueError("case.span must be two increasing numbers such as [0, 800], got "
                             f"{span!r}")
        if unknown := sorted(set(self.settings) - set(_SETTINGS)):
            names = (*_TEXTS, "vessel", *_OPTIONAL, *_SETTINGS)
            raise ValueError(f"case must have entries of {', '.join(names)}, got "
                             f"{', '.join(unknown)}")

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
        """Read the segmentation (256, 256) of the ground truth; None if the case has none.
        ``ValueError`` as for `measurements`."""
        if self.truth is None:
            return None
        path = measured_folder() / self.truth["file"]
        self._check(path, self.truth["sha256"])
        return read_truth(path)

    def _check(self, path: Path, digest: str) -> None:
        if not path.exists():
            fetch = f"Run `eitbench fetch {self.name}`, s" if self.address else "S"
            raise ValueError(
                f"{case_id(self.name)} requires the file {path.name} with sha256 "
                f"{digest}, from {self.source} (licence: {self.licence}). {fetch}ave it as {path}, "
                f"or set ${FOLDER_VARIABLE} to the folder that has {self.file}")
        check_file(path, digest, self.name)


def measured_folder() -> Path:
    """Return $EITBENCH_MEASURED, else $XDG_DATA_HOME/eitbench/measured, else
    ~/.local/share/eitbench/measured."""
    if folder := os.environ.get(FOLDER_VARIABLE):
        return Path(folder)
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(data) / "eitbench" / "measured"


def case_id(name: str) -> str:
    """Return the environment id under which ``import eitbench`` registers a case."""
    return f"eitbench/Measured-{name}-v0"


def read_case(name: Path | str) -> MeasuredCase:
    """Read a built-in case by name, or the case of a YAML file. ``ValueError`` names the file and
    the error."""
    path = Path(name)
    if path.suffix != ".yml":
        names = {each.stem: each for each in sorted(CASES.glob("*.yml"))}
        _check.choice("case, if not a YAML file,", str(name), names)
        path = names[str(name)]
    entries = load_yaml(path, "case")
    if missing := [each for each in (*_TEXTS, "vessel") if each not in entries]:
        raise ValueError(f"{path}: case must have {', '.join(missing)}")
    fixed = {each: entries.pop(each) for each in (*_TEXTS, "vessel", *_OPTIONAL) if each in entries}
    try:
        return MeasuredCase(path.stem, **fixed, settings=entries)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def check_file(path: Path, digest: str, case: str) -> None:
    """Raise ``ValueError`` unless a file or folder exists and has the sha256 of a case."""
    if (actual := file_sha256(path) if path.exists() else "nothing") != digest:
        raise ValueError(f"{path} must have the sha256 {digest} of the case {case}, got {actual}")


def file_sha256(path: Path) -> str:
    """Return the digest of a file, or of all files of a folder in the order of their names."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    digest = hashlib.sha256()
    for each in filter(Path.is_file, files):
        with each.open("rb") as stream:
            hashlib.file_digest(stream, lambda: digest)
    return digest.hexdigest()
