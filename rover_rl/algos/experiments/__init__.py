"""Experiments of several training runs: seeds, comparisons and sweeps."""
