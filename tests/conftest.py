"""Which tests are the core, what processes of a run share, and one BLAS thread for each (several on
few cores are slower, not faster)."""

import os
from pathlib import Path

import pytest

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"

TESTS = Path(__file__).parent
PLACES = {
    "studies": "study",                        # the statements and figures of the thesis
    "rl": "study",                             # trains agents
    "examples": "study",                       # installs two packages and plays with them
    "bench/test_cards.py": "study",            # plays every method of ours
    "bench/test_checkpoints.py": "study",      # plays every trained agent
    "bench/test_world_cards.py": "study",      # simulates every world of ours
    "report/test_site_browser.py": "browser",
}
"""What is not the core, by folder or file: `pytest -m "not browser and not study"` leaves it out."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark what is not the core, and begin with it: what takes long is not to be what is left at
    the end, when the other processes have nothing to do any more."""
    for item in items:
        place = item.path.relative_to(TESTS)
        for above in (place, *place.parents):
            if mark := PLACES.get(above.as_posix()):
                item.add_marker(mark)
    items.sort(key=lambda item: item.get_closest_marker("study") is None)


@pytest.fixture(scope="session")
def run_cache(tmp_path_factory):
    """A cache folder that all processes of this run share, and no other run."""
    own = tmp_path_factory.getbasetemp()
    return str((own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "episodes")
