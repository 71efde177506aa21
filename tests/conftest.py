"""Marks of slow tests, the cache that processes share, and one BLAS thread per process (several on
few cores are slower, not faster)."""

import hashlib
import os
import sys
from pathlib import Path

import pytest
from hypothesis import settings

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"
# Without compiled files every process that a test starts compiles numpy, pandas and eitbench again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

settings.register_profile("ours", deadline=None, derandomize=True, database=None)
settings.load_profile("ours")                         # no deadline, for busy machines; the same examples in each run
TESTS = Path(__file__).parent
PLACES = {
    "studies": "study",                        # reproduces statements and figures of the thesis
    "rl": "study",                             # trains agents
    "examples": "study",                       # installs and uses two packages
    "bench/test_golden.py": "study",           # simulates every world, runs every method
    "bench/test_checkpoints.py": "study",      # runs every trained agent
    "bench/test_verify.py": "study",           # reruns valid and falsified records
    "test_docs.py::test_documentation_builds": "study",
    "report/test_site.py::test_published_files_are_rendered_from_the_records": "study",
    "report/test_site_browser.py": "browser",
}
"""Slow tests by folder, file or test: `pytest -m "not browser and not study"` omits these two groups."""
for place in PLACES:
    assert (TESTS / place.partition("::")[0]).exists(), f"there is no {place}"


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark slow tests and run them first, so that no process is left with a long test at
    the end, when other processes are idle."""
    for item in items:
        file = item.path.relative_to(TESTS)
        test = f"{file.as_posix()}::{item.originalname}"
        for place in (test, file.as_posix(), *map(Path.as_posix, file.parents)):
            if mark := PLACES.get(place):
                item.add_marker(mark)
        if item.get_closest_marker("slow"):
            item.add_marker("study")
    items.sort(key=lambda item: item.get_closest_marker("study") is None)


@pytest.fixture(scope="session")
def run_cache(pytestconfig, tmp_path_factory):
    """Share a cache folder between all processes, and with the next run of the same code. (Users' caches
    depend on declared versions instead; tests must notice a change before its version is raised.)
    `pytest --cache-clear` empties it. With `-p no:cacheprovider` a folder of this process."""
    kept = getattr(pytestconfig, "cache", None)
    if not kept:
        return str(tmp_path_factory.mktemp("episodes"))
    code = hashlib.sha256()
    for names in (*(f"eitbench/{part}" for part in (
            "numerics/*", "physics/*", "worlds/*", "data/*", "estimation/covariance")), "examples/*/*/world"):
        for file in sorted(TESTS.parent.glob(f"{names}.py")):
            code.update(file.read_bytes())
    return str(kept.mkdir(f"episodes-{code.hexdigest()[:16]}"))


@pytest.fixture(scope="session")
def published():
    """Return the records in the repository, which take seconds to read."""
    from eitbench.bench.records import read_records  # after the number of BLAS threads is set
    return read_records(TESTS.parent / "leaderboards" / "results")


@pytest.fixture(scope="session", autouse=True)
def nobodys_own_cache(run_cache):
    """Use this cache folder in tests that set none, instead of the developer's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EITBENCH_CACHE", run_cache)
        yield
