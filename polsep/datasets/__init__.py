"""Rendered sets, and the fixed sets of known truth."""
