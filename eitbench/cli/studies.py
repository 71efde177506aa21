"""The figures of the thesis: they lie in ``studies/``, beside the package or shipped with it."""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType

from eitbench._files import shipped

NAME = "eitbench_thesis"
"""Under which the package in ``studies/thesis`` is imported, wherever it lies."""


def thesis() -> ModuleType:
    """The package of ``studies/thesis``, whose ``FIGURES`` names what can be drawn."""
    if NAME not in sys.modules:
        folder = shipped("studies") / "thesis"
        spec = importlib.util.spec_from_file_location(
            NAME, folder / "__init__.py", submodule_search_locations=[str(folder)])
        assert spec is not None and spec.loader is not None
        sys.modules[NAME] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[NAME])
    return sys.modules[NAME]
