"""Benchmarks: speed and error, as ratios inside one run."""
