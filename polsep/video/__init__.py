"""Recordings in, separated recordings out."""
