"""Readings of a real instrument: how they are computed, calibrated, and made into a `Task`."""
