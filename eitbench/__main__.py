"""``python -m eitbench``: the command line."""

from eitbench.cli.__main__ import main

main()
