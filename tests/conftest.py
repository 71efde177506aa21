"""One BLAS thread in every test process (several on few cores are slower, not faster), and the long studies first."""

import os

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"


def pytest_collection_modifyitems(items):
    """Begin with the studies, so that the other workers do the rest meanwhile."""
    items.sort(key=lambda item: "studies" not in item.path.parts)
