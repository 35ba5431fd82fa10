"""Compiling, threads, workers, cluster, filters: nothing here knows of light."""
