"""Compiling, row arithmetic, threads, workers, a cluster: nothing here depends on optics."""
