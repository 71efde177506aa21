"""Floor 9: the command line."""

from eitbench.cli.app import app

__all__ = ["app"]
