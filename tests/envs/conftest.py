from pathlib import Path

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items):
    """Run the tests of the full filter first, in sequence: a process computes its open-loop covariance in 30 s,
    and caches it for the last worlds only."""
    items.sort(key=lambda item: item.path.parent != HERE or "full" not in item.name)
