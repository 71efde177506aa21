"""Digests of code: what other code computed is not taken for the same."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterable
from pathlib import Path

from eitbench._files import PACKAGE


def code_digest(files: Iterable[Path]) -> str:
    """SHA-256 of these files, in this order, but for the docstrings of Python's: words may be
    mended without anything being computed anew."""
    return hashlib.sha256(b"".join(map(_without_docstrings, files))).hexdigest()


def package_files(*patterns: str) -> list[Path]:
    """Files of this package that match, in order. ``FileNotFoundError`` if a pattern matches
    nothing, since a digest would leave out what has moved."""
    found: list[Path] = []
    for pattern in patterns:
        if not (files := list(PACKAGE.glob(pattern))):
            raise FileNotFoundError(f"there is no file {pattern} in {PACKAGE}")
        found += files
    return sorted(found)


def _without_docstrings(file: Path) -> bytes:
    code = file.read_bytes()
    try:
        nodes = list(ast.walk(ast.parse(code))) if file.suffix == ".py" else []
    except (SyntaxError, ValueError):                       # being written just now
        return code
    said = [node for node in nodes if isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)]
    begins = [0]
    for line in code.splitlines(keepends=True):
        begins.append(begins[-1] + len(line))
    for node in sorted(said, key=lambda node: (node.lineno, node.col_offset), reverse=True):
        assert node.end_lineno is not None and node.end_col_offset is not None
        code = (code[:begins[node.lineno - 1] + node.col_offset]
                + code[begins[node.end_lineno - 1] + node.end_col_offset:])
    return code
