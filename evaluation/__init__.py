"""The laboratory: the paper's tables, the test sets, galleries and peers, from a checkout of the repository."""
