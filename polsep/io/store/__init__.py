"""What polsep keeps for itself: whole files, weights, checkpoints, rows of results."""
