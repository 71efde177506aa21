"""Cases of the measured board: a record of a real instrument, its vessel, and how it is judged.

A case is a YAML file. It names the record's file by its sha256 and never holds the data.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from eitbench._extras import needed_by
from eitbench.bench.segmentation import read_truth

if TYPE_CHECKING:
    import numpy as np

    from eitbench.envs.measured import MeasuredEnv

WITHHELD = 0.1
"""Part of the readings by which methods are judged."""
SEEDS = range(5)
"""By which those are drawn, one play each."""
BLOCK = 1 << 20
"""bytes of a file that are read at once"""
_WORDS = ("title", "file", "sha256", "licence", "source")
_NEEDED = (*_WORDS, "vessel")
"""Entries that every case has."""
_SHA256 = re.compile("[0-9a-f]{64}")
_SETTINGS = ("format", "span", "correction", "homogeneous_frames", "moves", "model_error")
"""Arguments of `eitbench.data.measured.read` and `MeasuredEnv` that it may have, and ``span``: the
first reading, from 0, and the one after the last, where a part of a record is enough."""


@dataclass(frozen=True, eq=False)
class Case:
    """What a method is judged on; all methods of a case have the same vessel and settings.

    ``ValueError`` naming the entry that is missing, unknown, or of the wrong kind.
    """

    name: str
    title: str
    file: str
    """name of the record's file or folder, for those who look for it"""
    sha256: str
    """of that file; of a folder, of its files one after another"""
    licence: str
    source: str
    """where it can be had"""
    vessel: Mapping[str, Any]
    """entries as of `read_vessel`"""
    beside: Mapping[str, str] = field(default_factory=dict)
    """name -> sha256 of files beside the record's that the reader takes too"""
    truth: Mapping[str, str] | None = None
    """``file`` and ``sha256`` of a segmentation as of `eitbench.bench.segmentation.read_truth`, if
    there is one"""
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in _WORDS:
            value = getattr(self, name)
            if not isinstance(value, str) or not value.strip():
                raise ValueError(f"case.{name} must be a text, got {value!r}")
        for name in ("vessel", "beside"):
            if not isinstance(getattr(self, name), Mapping):
                raise ValueError(f"case.{name} must be entries like 'name: value', got "
                                 f"{getattr(self, name)!r}")
        if self.truth is not None and set(self.truth) != {"file", "sha256"}:
            raise ValueError(f"case.truth must have file and sha256, got {self.truth!r}")
        truth = {"truth.sha256": self.truth["sha256"]} if self.truth else {}
        for name, digest in {"sha256": self.sha256, **self.beside, **truth}.items():
            if not isinstance(digest, str) or not _SHA256.fullmatch(digest):
                raise ValueError(f"case.{name} must be 64 digits from 0 to f, got {digest!r}")
        span = self.settings.get("span", [0, 1])
        if (not isinstance(span, list) or len(span) != 2
                or not all(isinstance(end, int) for end in span) or not 0 <= span[0] < span[1]):
            raise ValueError("case.span must be two numbers such as [0, 800], the first not "
                             f"negative and the second larger, got {span!r}")
        if unknown := sorted(set(self.settings) - set(_SETTINGS)):
            raise ValueError(f"case has no {', '.join(unknown)}; there are "
                             f"{', '.join((*_NEEDED, 'beside', 'truth', *_SETTINGS))}")

    @cached_property
    def digest(self) -> str:
        """sha256 of all that numbers depend on; words may be mended."""
        content = {"sha256": self.sha256, "beside": dict(self.beside),
                   "truth": self.truth and self.truth["sha256"],
                   "vessel": dict(self.vessel), "withheld": WITHHELD,
                   "settings": dict(self.settings)}
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def env(self, file: Path | str) -> MeasuredEnv:
        """The case as an environment, from the record's ``file``; ``ValueError`` if that is another
        one."""
        from eitbench.data.measured import read
        from eitbench.envs.measured import MeasuredEnv
        file = Path(file)
        wanted = {file: self.sha256} | {file.with_name(name): digest
                                        for name, digest in self.beside.items()}
        for path, digest in wanted.items():
            if (found := file_sha256(path)) != digest:
                raise ValueError(f"data must be {self.file} of the case {self.name}: the sha256 of "
                                 f"{path} must be {digest}, got {found}")
        settings = dict(self.settings)
        span = settings.pop("span", None)
        record = read(file, settings.pop("format", None), None if span is None else slice(*span))
        return MeasuredEnv(record, dict(self.vessel), withheld=WITHHELD, **settings)

    def true_picture(self, file: Path | str | None) -> np.ndarray | None:
        """The truth in this ``file``, None if the case has none; ``ValueError`` if there is one and
        the file is another, or not given."""
        if self.truth is None:
            if file is not None:
                raise ValueError(f"truth must not be given: the case {self.name} has none")
            return None
        if file is None or (found := file_sha256(Path(file))) != self.truth["sha256"]:
            got = "none" if file is None else f"{file} with {found}"
            raise ValueError(f"truth must be {self.truth['file']} of the case {self.name}, with "
                             f"the sha256 {self.truth['sha256']}, got {got}")
        return read_truth(file)


def read_case(path: Path | str) -> Case:
    """The case that a YAML file describes; its name is that of the file. ``ValueError`` naming the
    file and what is wrong with it."""
    path = Path(path)
    with needed_by("a case in a YAML file"):
        import yaml
    try:
        said = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ValueError(f"case must be a YAML file, got {path}: {error}") from None
    if not isinstance(said, dict):
        raise ValueError(f"case must be a YAML file of entries like 'title: a rod', got {path}")
    if missing := [name for name in _NEEDED if name not in said]:
        raise ValueError(f"{path}: case must have {', '.join(missing)}")
    own = {name: said.pop(name) for name in _NEEDED}
    more = {name: said.pop(name) for name in ("beside", "truth") if name in said}
    try:
        return Case(path.stem, **own, **more, settings=said)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def read_cases(folder: Path) -> list[Case]:
    """All cases of a folder, by name; none if there is no such folder."""
    return [read_case(path) for path in sorted(Path(folder).glob("*.yml"))]


def file_sha256(path: Path) -> str:
    """Of a file; of a folder, of all files in it one after another, by name. ``ValueError`` if
    there is none."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    files = [each for each in files if each.is_file()]
    if not files:
        raise ValueError(f"data must be a file or a folder of files, there is none at {path}")
    digest = hashlib.sha256()
    for each in files:
        with each.open("rb") as stream:
            while block := stream.read(BLOCK):
                digest.update(block)
    return digest.hexdigest()
