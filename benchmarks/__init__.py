"""Benchmarks, a folder per subject; ``python benchmarks/run.py`` runs all of them."""
