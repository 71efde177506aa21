"""Measurements of real instruments: files, vessels, calibration, and the task of an estimator."""

from eitbench.measured.measurements import Measurements
from eitbench.measured.readers import read

__all__ = ["Measurements", "read"]
