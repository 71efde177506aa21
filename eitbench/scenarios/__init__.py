"""Floor 2: one short file per example; a scenario says what world it is, with the source of every number."""

from eitbench.scenarios.pipe2d import Pipe2D

__all__ = ["Pipe2D"]
