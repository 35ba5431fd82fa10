"""Atomic files, checks and codecs for the rest of `io`, and files that polsep keeps for itself."""
