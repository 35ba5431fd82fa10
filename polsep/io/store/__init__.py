"""Atomic files, checks and codecs for the other rooms, and files that polsep keeps for itself."""
