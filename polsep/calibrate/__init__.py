"""Measurement of a sensor and a lamp from raw frames, and merging of exposures."""
