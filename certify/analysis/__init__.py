"""Judges many networks: checkpoints, runs, sweeps, and the counts of a comparison."""
