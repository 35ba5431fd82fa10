"""Readers of raw frames and recordings."""
