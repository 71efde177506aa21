from pathlib import Path

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items):
    """Begin with the tests of the full filter, one after another: a process computes its open-loop covariance in 30 s,
    and keeps that of the last worlds only."""
    items.sort(key=lambda item: item.path.parent != HERE or "full" not in item.name)
