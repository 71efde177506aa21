"""`python -m eitbench.cli` is the command `eitbench`."""

from eitbench.cli import app

app()
