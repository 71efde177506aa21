"""The thesis' pipe with episodes of a third of a second."""

from eitbench.worlds.catalogue import PIPE_2D

from short import FAST

TINY = PIPE_2D.with_changes(FAST)
