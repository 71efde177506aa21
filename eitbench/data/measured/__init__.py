"""Records of real instruments: one container, and a reader for each kind of file."""

from eitbench.data.measured.measurements import Measurements
from eitbench.data.measured.reading import read

__all__ = ["Measurements", "read"]
